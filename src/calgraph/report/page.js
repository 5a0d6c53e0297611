"use strict";

// Figures: their data stand beside them as JSON, with colours by the names that they have in the style sheet.
const figures = new Map();
for (const source of document.querySelectorAll("script.figure-data")) {
  figures.set(source.dataset.for, { text: source.textContent, state: null, drawn: false });
}

const draw = (id) => {
  const style = getComputedStyle(document.documentElement);
  const one = figures.get(id);
  const figure = JSON.parse(one.text.replace(/var\((--[a-z-]+)\)/g, (_, name) => style.getPropertyValue(name).trim()));
  const config = { responsive: true, displaylogo: false, displayModeBar: false };
  one.drawn = true;
  const data = one.state === null ? figure.data : inState(figure, one.state);
  Plotly.react(document.getElementById(id), data, { ...figure.layout, uirevision: "kept" }, config);
};

// Where scanners were before: what each saw, moved by (cos, sin, x, y); what is only known in the end is hidden.
const inState = (figure, state) =>
  figure.data.map((trace) => {
    const { scanner, last } = trace.meta;
    const [c, s, x, y] = figure.states[state][scanner];
    const moved = (f) => trace.x.map((v, i) => (v === null ? null : f(v, trace.y[i])));
    const visible = last && state < figure.states.length - 1 ? false : trace.visible ?? true;
    return { ...trace, visible, x: moved((u, v) => c * u - s * v + x), y: moved((u, v) => s * u + c * v + y) };
  });

for (const chooser of document.querySelectorAll("fieldset.states")) {
  chooser.addEventListener("change", (event) => {
    figures.get(chooser.dataset.for).state = Number(event.target.value);
    draw(chooser.dataset.for);
  });
}

// A figure is drawn when it comes near the window; all are for paper, in the colours of paper.
const near = new IntersectionObserver(
  (entries) => {
    for (const { isIntersecting, target } of entries) {
      if (isIntersecting && !figures.get(target.id).drawn) draw(target.id);
    }
  },
  { rootMargin: "600px" },
);
for (const id of figures.keys()) near.observe(document.getElementById(id));
const redraw = () => figures.forEach((one, id) => one.drawn && draw(id));
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
const onPaper = (yes) => {
  document.documentElement.classList.toggle("on-paper", yes);
  figures.forEach((_, id) => draw(id));
  for (const place of document.querySelectorAll(".figure")) Plotly.Plots.resize(place);
};
window.addEventListener("beforeprint", () => onPaper(true));
window.addEventListener("afterprint", () => onPaper(false));

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
