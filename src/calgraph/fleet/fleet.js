"use strict";

const table = document.getElementById("fleet");
const body = table.tBodies[0];
const rows = Array.from(body.rows);
const heads = Array.from(table.tHead.rows[0].cells);

// A click on the head of a column sorts by it, a second one in the opposite order.
const key = (row, column) => {
  const value = row.cells[column].dataset.sort;
  return value === undefined ? row.cells[column].textContent : Number(value);
};
const compare = (a, b) => (typeof a === "number" ? a - b : a.localeCompare(b, undefined, { numeric: true }));
for (const head of heads) {
  if (head.dataset.column === undefined) continue;
  head.addEventListener("click", () => {
    const ascending = head.getAttribute("aria-sort") !== "ascending";
    for (const other of heads) other.removeAttribute("aria-sort");
    head.setAttribute("aria-sort", ascending ? "ascending" : "descending");
    const column = Number(head.dataset.column);
    rows.sort((a, b) => (ascending ? 1 : -1) * compare(key(a, column), key(b, column)));
    body.append(...rows);
  });
}

const state = document.getElementById("filter-state");
const text = document.getElementById("filter-text");
const count = document.getElementById("filter-count");
const filter = () => {
  const words = text.value.trim().toLowerCase();
  let shown = 0;
  for (const row of rows) {
    const states = row.dataset.states.split(" ");
    row.hidden = Boolean(
      (state.value && !states.includes(state.value)) || (words && !row.textContent.toLowerCase().includes(words)),
    );
    shown += row.hidden ? 0 : 1;
  }
  count.textContent = `${shown} of ${rows.length} robots`;
};
for (const control of [state, text]) control.addEventListener("input", filter);
filter();
