// One card per sensor: its view, what it detects, captures, coverage, and uncertainty against the tolerance.

import { byId, formatCount, formatLength, make, setOptionalText, setText } from "./dom.js";

const KINDS = { camera: "camera", lidar2d: "2-D scanner", lidar3d: "3-D LiDAR" };
const cards = new Map();

/** Brings the cards in line with the state; their order is that of the rig. */
export function showSensors(state) {
  const names = new Set(state.sensors.map((sensor) => sensor.name));
  for (const [name, card] of cards) {
    if (!names.has(name)) {
      card.element.remove();
      cards.delete(name);
    }
  }
  for (const sensor of state.sensors) {
    if (!cards.has(sensor.name)) {
      cards.set(sensor.name, makeCard(sensor));
      byId("cards").append(cards.get(sensor.name).element);
    }
    updateCard(cards.get(sensor.name), sensor, state);
  }
}

function makeCard(sensor) {
  const part = Object.fromEntries(
    ["board", "precision", "tolerance", "captures", "problem"].map((name) => [name, make("p", name)]),
  );
  const name = make("h3");
  setText(name, sensor.name);
  const image = make("img", "view");
  image.alt = "";
  const kind = make("span", "kind", KINDS[sensor.kind] ?? sensor.kind);
  const view = make("div", "frame", image, make("span", "blank", "no picture yet"));
  const bar = make("div", "bar", make("span"));
  bar.setAttribute("role", "progressbar");
  bar.setAttribute("aria-label", `Tolerance over uncertainty of ${sensor.name}`);
  const coverage = make("div", "coverage");
  coverage.setAttribute("role", "img");
  const numbers = make("div", "numbers", part.precision, bar, part.tolerance);
  const element = make(
    "li", "card", view, make("div", "title", name, kind), part.board, numbers,
    make("div", "extent", coverage, part.captures), part.problem,
  );
  image.onload = () => element.classList.add("pictured");
  return { element, image, bar, coverage, part };
}

function updateCard(card, sensor, state) {
  const { element, part, bar } = card;
  const isRoot = sensor.name === state.root;
  const isOpen = sensor.stddev_mm !== null;
  element.dataset.state = sensor.problem ? "problem" : sensor.progress >= 1 ? "within" : isOpen ? "open" : "none";
  element.dataset.board = sensor.sees_board === null ? "unknown" : sensor.sees_board ? "yes" : "no";
  setOptionalText(part.board, state.kind === "rig" ? describeBoard(sensor) : sensor.reason);
  setText(part.precision, describePrecision(sensor, isRoot, state));
  setOptionalText(part.tolerance, isRoot ? "" : describeTolerance(sensor, state));
  setText(part.captures, state.kind === "rig" ? formatCount(sensor.captures, "capture") : describeMessages(sensor, state.kind));
  setOptionalText(part.problem, sensor.problem);
  const percent = Math.round(100 * sensor.progress);
  bar.firstChild.style.width = `${percent}%`;
  bar.setAttribute("aria-valuenow", percent);
  bar.hidden = isRoot;
  showCoverage(card, sensor);
  loadPicture(card, sensor);
}

function describeBoard(sensor) {
  if (sensor.sees_board) return sensor.moving ? "board detected, moving" : "board detected";
  if (sensor.sees_board === null) return sensor.moving ? "moving" : "";
  return sensor.reason || "board not detected";
}

function describePrecision(sensor, isRoot, state) {
  if (isRoot) return "reference frame";
  if (sensor.stddev_mm === null) return state.kind === "network" ? "not yet connected" : "no pose yet";
  const angle = sensor.stddev_degrees === null ? "" : ` · ${formatLength(sensor.stddev_degrees)}°`;
  return `σ ${formatLength(sensor.stddev_mm)} mm${angle}`;
}

function describeTolerance(sensor, state) {
  if (!state.tolerance_mm || sensor.stddev_mm === null) return "";
  if (sensor.progress >= 1) return "within tolerance";
  return `tolerance ${formatLength(state.tolerance_mm)} mm · ${formatLength(state.tolerance_degrees)}°`;
}

function describeMessages(sensor, kind) {
  const noun = kind === "network" ? "scans" : "messages";
  const rate = sensor.rate ? `${formatLength(sensor.rate)} ${noun}/s` : `no ${noun}`;
  const offset = sensor.clock_ms === null ? null : Math.round(sensor.clock_ms);
  const clock = offset === null ? "" : ` · clock ${offset > 0 ? "+" : ""}${offset}\u00a0ms`;
  return `${kind === "network" ? `${formatCount(sensor.captures, "track")} · ` : ""}${rate}${clock}`;
}

/** Shares of the regions of an image, or of directions around a scanner from above, of which forward is up. */
function showCoverage({ coverage }, { kind, coverage: shares }) {
  const key = shares.join();
  if (coverage.dataset.shown === key) return;
  coverage.dataset.shown = key;
  const filled = shares.filter((share) => share > 0).length;
  const isGrid = kind === "camera";
  coverage.className = isGrid ? "coverage grid" : "coverage ring";
  coverage.setAttribute("aria-label", `${filled} of ${shares.length} ${isGrid ? "image regions" : "sectors"} with boards`);
  coverage.replaceChildren(...shares.map((share, index) => {
    const cell = make("span", share > 0 ? "covered" : "");
    // A region with a single board is visible, too.
    if (share > 0) cell.style.opacity = 0.3 + 0.7 * share;
    if (!isGrid) cell.style.transform = `rotate(${180 - (360 * (index + 0.5)) / shares.length}deg) translateY(-16px)`;
    return cell;
  }));
}

/** Loads the newest picture; those that come while one is loading are skipped. */
function loadPicture({ image }, { name, picture }) {
  if (!picture || image.dataset.number === String(picture) || !image.complete) return;
  image.dataset.number = picture;
  image.src = `/picture?sensor=${encodeURIComponent(name)}&number=${picture}`;
}
