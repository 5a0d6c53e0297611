// Elements and their texts. Texts of a session are set as text, never parsed as markup: names of sensors are input.

export const byId = (id) => document.getElementById(id);

/** An element with a class, and with children or a text. */
export function make(tag, name = "", ...children) {
  const made = document.createElement(tag);
  if (name) made.className = name;
  made.append(...children);
  return made;
}

// Longer words may break after underscores.
const LONG_WORD = 16;

/** Sets a text where it differs, so that readers of screens repeat nothing. */
export function setText(element, text) {
  if (element.textContent !== text) element.replaceChildren(...String(text).split(/(\s+)/).flatMap(allowBreaks));
}

function allowBreaks(word) {
  if (word.length <= LONG_WORD) return [word];
  return word.split("_").flatMap((part, index) => (index ? ["_", make("wbr"), part] : [part]));
}

/** Sets a text and hides the element where there is none. */
export function setOptionalText(element, text) {
  setText(element, text);
  element.hidden = !text;
}

/** Shows an SVG text as an image, in which no script runs and nothing is loaded; hides it where there is none. */
export function setPicture(image, svg) {
  image.hidden = !svg;
  if (!svg || image.shown === svg) return;
  image.shown = svg;
  image.src = `data:image/svg+xml;charset=utf-8,${encodeURIComponent(svg)}`;
}

export const formatCount = (count, noun) => `${count.toLocaleString("en")} ${noun}${count === 1 ? "" : "s"}`;

/** Seconds as minutes:seconds, or hours:minutes:seconds. */
export function formatTime(seconds) {
  const whole = Math.floor(seconds);
  const parts = [Math.floor(whole / 60) % 60, whole % 60].map((part) => String(part).padStart(2, "0"));
  return (whole >= 3600 ? [Math.floor(whole / 3600), ...parts] : parts).join(":");
}

/** Two significant digits at most below 10, none after the point above. */
export const formatLength = (value) => (value < 10 ? Number(value.toPrecision(2)) : Math.round(value)).toLocaleString("en");
