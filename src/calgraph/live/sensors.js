// One card per sensor: its view, what it detects, captures, coverage, and uncertainty against the tolerance.

import { byId, draw, formatCount, formatLength, make, setOptionalText, setText } from "./dom.js";

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
  const numbers = make("div", "numbers", part.precision, bar, part.tolerance);
  const element = make(
    "li", "card", view, make("div", "title", name, kind), part.board, numbers,
    make("div", "extent", coverage, part.captures), part.problem,
  );
  return { element, image, bar, coverage, part, loading: false, loaded: 0 };
}

function updateCard(card, sensor, state) {
  const { element, part, bar } = card;
  const isRoot = sensor.name === state.root;
  const isOpen = sensor.stddev_mm !== null;
  element.dataset.state = sensor.problem ? "problem" : sensor.progress >= 1 ? "within" : isOpen ? "open" : "none";
  element.dataset.board = sensor.sees_board === null ? "unknown" : sensor.sees_board ? "yes" : "no";
  setOptionalText(part.board, state.kind === "network" ? sensor.reason : describeBoard(sensor));
  setText(part.precision, describePrecision(sensor, isRoot, state));
  setOptionalText(part.tolerance, isRoot ? "" : describeTolerance(sensor, state));
  setText(part.captures, state.kind === "network" ? describeTracks(sensor) : formatCount(sensor.captures, "capture"));
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

function describeTracks(sensor) {
  const rate = sensor.rate ? `${formatLength(sensor.rate)} scans/s` : "no scans";
  const offset = sensor.clock_ms === null ? null : Math.round(sensor.clock_ms);
  const clock = offset === null ? "" : ` · clock ${offset > 0 ? "+" : ""}${offset}\u00a0ms`;
  return `${formatCount(sensor.captures, "track")} · ${rate}${clock}`;
}

function showCoverage(card, sensor) {
  const shares = sensor.coverage;
  const key = shares.join();
  if (card.coverageShown === key) return;
  card.coverageShown = key;
  if (!shares.length) {
    card.coverage.replaceChildren();
    return;
  }
  const filled = shares.filter((share) => share > 0).length;
  const isGrid = sensor.kind === "camera";
  const title = `${filled} of ${shares.length} ${isGrid ? "image regions" : "sectors"} with boards`;
  const marks = isGrid ? drawGrid(shares) : drawRing(shares);
  const box = isGrid ? "0 0 44 34" : "-22 -22 44 44";
  card.coverage.replaceChildren(draw("svg", { viewBox: box, role: "img", "aria-label": title }, ...marks));
}

// A region with a single board is visible, too.
const shade = (share) => (share > 0 ? 0.3 + 0.7 * Math.min(1, share) : 0);

function drawCell(tag, place, share) {
  return [draw(tag, { ...place, class: "absent" }), draw(tag, { ...place, class: "covered", "fill-opacity": shade(share) })];
}

function drawGrid(shares) {
  return shares.flatMap((share, index) => {
    const place = { x: 1 + 14.2 * (index % 3), y: 1 + 11 * Math.floor(index / 3), width: 13, height: 9.8, rx: 1.5 };
    return drawCell("rect", place, share);
  });
}

/** A ring viewed from above: x, forward, is up; angles are counter-clockwise. */
function drawRing(shares) {
  const step = (2 * Math.PI) / shares.length;
  const gap = Math.min(0.06, step / 6);
  const point = (radius, angle) => `${(-radius * Math.sin(angle)).toFixed(2)} ${(-radius * Math.cos(angle)).toFixed(2)}`;
  return shares.flatMap((share, index) => {
    const [from, to] = [-Math.PI + index * step + gap, -Math.PI + (index + 1) * step - gap];
    const d = `M${point(21, from)} A21 21 0 0 0 ${point(21, to)} L${point(12, to)} A12 12 0 0 1 ${point(12, from)}Z`;
    return drawCell("path", { d }, share);
  });
}

/** Loads the newest picture; those that came while one was loading are skipped. */
function loadPicture(card, sensor) {
  card.wanted = sensor.picture;
  if (card.loading || !card.wanted || card.wanted === card.loaded) return;
  card.loading = true;
  const number = card.wanted;
  const next = make("img", "view");
  next.alt = "";
  const finish = () => {
    card.loading = false;
    card.loaded = number;
    loadPicture(card, { ...sensor, picture: card.wanted });
  };
  next.onerror = finish;
  next.onload = () => {
    card.image.replaceWith(next);
    card.image = next;
    card.element.classList.add("pictured");
    finish();
  };
  next.src = `/picture?sensor=${encodeURIComponent(sensor.name)}&number=${number}`;
}
