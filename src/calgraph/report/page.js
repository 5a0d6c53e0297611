"use strict";

// Figures: their data are JSON elements, with colours by the names of the style sheet's variables.
const figures = new Map();
for (const source of document.querySelectorAll("script.figure-data")) {
  figures.set(source.dataset.for, { text: source.textContent, drawn: false });
}

const draw = (id) => {
  const style = getComputedStyle(document.documentElement);
  const one = figures.get(id);
  const figure = JSON.parse(one.text.replace(/var\((--[a-z-]+)\)/g, (_, name) => style.getPropertyValue(name).trim()));
  for (const chooser of document.querySelectorAll("fieldset.choice")) {
    if (chooser.dataset.for === id) choose(figure, figure.choices[chooser.dataset.of][chooser.querySelector(":checked").value]);
  }
  const place = document.getElementById(id);
  const key = place.previousElementSibling;
  if (key?.matches(".key.narrow")) figure.layout.showlegend = getComputedStyle(key).display === "none";
  const config = { responsive: true, displaylogo: false, displayModeBar: false };
  one.drawn = true;
  Plotly.react(place, figure.data, { ...figure.layout, uirevision: "kept" }, config);
};

// Applies the changes of a button: visibility of traces, parts of the layout, and poses of scanners.
const choose = (figure, { visible = [], layout = {}, moves }) => {
  visible.forEach((shown, k) => { if (shown !== null) figure.data[k].visible = shown; });
  merge(figure.layout, layout);
  if (moves) for (const trace of figure.data) move(trace, moves[trace.meta]);
};

const merge = (into, from) => {
  for (const [key, value] of Object.entries(from)) {
    if (value !== null && typeof value === "object" && !Array.isArray(value)) merge(into[key], value);
    else into[key] = value;
  }
};

const move = (trace, [c, s, x, y]) => {
  const moved = (f) => trace.x.map((u, k) => (u === null ? null : f(u, trace.y[k])));
  [trace.x, trace.y] = [moved((u, v) => c * u - s * v + x), moved((u, v) => s * u + c * v + y)];
};

for (const chooser of document.querySelectorAll("fieldset.choice")) {
  chooser.addEventListener("change", () => draw(chooser.dataset.for));
}

// A figure is drawn when it comes near the window; for printing all are drawn, in the colours of paper.
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
const sections = document.querySelectorAll("details.section");
const onPaper = (yes) => {
  // Those that the reader opened remain open.
  for (const one of sections) {
    if (yes) one.dataset.opened = one.open;
    one.open = yes || one.dataset.opened === "true";
  }
  document.documentElement.classList.toggle("on-paper", yes);
  figures.forEach((_, id) => draw(id));
  for (const place of document.querySelectorAll(".figure")) Plotly.Plots.resize(place);
};
window.addEventListener("beforeprint", () => onPaper(true));
window.addEventListener("afterprint", () => onPaper(false));

// A link to a folded section opens it.
const unfold = () => {
  for (const one of sections) if (location.hash === `#${one.id}`) one.open = true;
};
window.addEventListener("hashchange", unfold);
unfold();

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

// What scrolls horizontally shows at which sides more follows.
const scrollers = document.querySelectorAll(".wide, .tall, .scroller, nav");
const markOverflow = (box) => {
  box.classList.toggle("more-left", box.scrollLeft > 2);
  box.classList.toggle("more-right", box.scrollLeft + box.clientWidth < box.scrollWidth - 2);
};
const overflow = new ResizeObserver((entries) => entries.forEach(({ target }) => markOverflow(target)));
for (const box of scrollers) {
  overflow.observe(box);
  box.addEventListener("scroll", () => markOverflow(box), { passive: true });
}
