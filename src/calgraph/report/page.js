"use strict";

// Figures: their data stand beside them as JSON.
for (const source of document.querySelectorAll("script.figure-data")) {
  const place = document.getElementById(source.dataset.for);
  const figure = JSON.parse(source.textContent);
  Plotly.newPlot(place, figure.data, figure.layout, { responsive: true, displaylogo: false, displayModeBar: false });
}

// On paper a figure has another width than on the screen.
const resizeAll = () => document.querySelectorAll(".figure").forEach((place) => Plotly.Plots.resize(place));
window.addEventListener("beforeprint", resizeAll);
window.addEventListener("afterprint", resizeAll);

// The table of captures.
const table = document.getElementById("capture-table");
if (table) {
  const rows = Array.from(table.tBodies[0].rows);
  const sensor = document.getElementById("filter-sensor");
  const outcome = document.getElementById("filter-outcome");
  const text = document.getElementById("filter-text");
  const count = document.getElementById("filter-count");
  const filter = () => {
    const words = text.value.trim().toLowerCase();
    let shown = 0;
    for (const row of rows) {
      const hidden =
        (sensor.value && row.dataset.sensor !== sensor.value) ||
        (outcome.value && row.dataset.outcome !== outcome.value) ||
        (words && !row.textContent.toLowerCase().includes(words));
      row.hidden = Boolean(hidden);
      shown += hidden ? 0 : 1;
    }
    count.textContent = `${shown} of ${rows.length} rows`;
  };
  for (const control of [sensor, outcome, text]) control.addEventListener("input", filter);
  filter();
}
