// The 3-D view of wide screens: sensors with poses, boards of the captures, and where the board should be next.

import { byId } from "./dom.js";
import { boundsOf, makeView, outlineOf } from "./orbit.js";

const COLORS = { good: "#3be28d", weak: "#ffbd45", unobservable: "#ff7369" };
const ROOT = "#ffffff";
const BOARD = "#8fa3b8";
const SUGGESTED = "#6bbcff";
// Standard deviations of some mm would not be visible in a view of some m.
const ENLARGEMENT = 20;
const SIZE = 0.25;
const WIDE = window.matchMedia("(min-width: 1000px) and (min-height: 561px)");

const canvas = byId("scene");
const view = makeView(canvas, draw);
let scene = null;
let shown = 0;
let wanted = 0;
let loading = false;

/** Loads the newest scene where the view is on the screen. */
export function showScene(state) {
  wanted = state.kind === "rig" ? state.scene : 0;
  byId("no-scene").hidden = Boolean(wanted && scene);
  if (wanted && wanted !== shown && !loading && WIDE.matches) load();
}

WIDE.addEventListener("change", () => wanted && wanted !== shown && WIDE.matches && load());

async function load() {
  loading = true;
  const number = wanted;
  const answer = await fetch("/scene").catch(() => null);
  loading = false;
  shown = number;
  if (!answer?.ok) return;
  scene = await answer.json();
  byId("no-scene").hidden = true;
  view.frame(boundsOf(scene));
  draw();
}

function draw() {
  if (!scene) return;
  const context = view.begin();
  drawFloor(context);
  for (const board of scene.boards) fillBoard(context, board, BOARD, 0.14);
  if (scene.suggested) fillBoard(context, scene.suggested, SUGGESTED, 0.4);
  for (const frame of scene.frames) drawFrame(context, frame);
  drawNames(context);
}

const colorOf = (frame) => (frame.covariance ? (COLORS[frame.grade] ?? BOARD) : ROOT);

/** Names beside their sensors, one below the other where they would cover each other. */
function drawNames(context) {
  context.font = "600 14px system-ui, sans-serif";
  context.lineWidth = 4;
  context.strokeStyle = "#0b0f14";
  const placed = [];
  const names = scene.frames.map((frame) => ({ frame, at: view.project(outlineOf(frame, SIZE).anchor) }));
  for (const { frame, at } of names.sort((a, b) => a.at[1] - b.at[1])) {
    const [x, width] = [at[0] + 14, context.measureText(frame.name).width];
    let y = at[1] - 8;
    for (const other of placed) {
      const isBeside = x > other.x + other.width || other.x > x + width;
      if (!isBeside) y = Math.max(y, other.y + 18);
    }
    placed.push({ frame, x, y, width });
  }
  // Those below the lower border move up, all by as much.
  const below = Math.max(0, ...placed.map(({ y }) => y + 6 - canvas.clientHeight));
  for (const { frame, x, y } of placed) {
    context.strokeText(frame.name, x, y - below);
    context.fillStyle = colorOf(frame);
    context.fillText(frame.name, x, y - below);
  }
}

/** A grid of 1 m at the height of the lowest point. */
function drawFloor(context) {
  const [low, high] = boundsOf(scene);
  const [x0, y0, x1, y1] = [Math.floor(low[0]) - 1, Math.floor(low[1]) - 1, Math.ceil(high[0]) + 1, Math.ceil(high[1]) + 1];
  // Scenes of some km, which only wrong poses make, have no grid.
  if (x1 - x0 > 60 || y1 - y0 > 60) return;
  context.strokeStyle = "#1d2630";
  context.lineWidth = 1;
  for (let x = x0; x <= x1; x += 1) strokePath(context, [[x, y0, low[2]], [x, y1, low[2]]]);
  for (let y = y0; y <= y1; y += 1) strokePath(context, [[x0, y, low[2]], [x1, y, low[2]]]);
}

function drawFrame(context, frame) {
  const color = colorOf(frame);
  const { lines, anchor } = outlineOf(frame, SIZE);
  context.strokeStyle = color;
  context.lineWidth = 2;
  for (const line of lines) strokePath(context, line);
  if (frame.covariance) drawUncertainty(context, frame, anchor, color);
}

/** The ellipsoid of one standard deviation, enlarged, as the ellipse that it is on the screen. */
function drawUncertainty(context, frame, anchor, color) {
  const [a, b, c] = view.projectCovariance(frame.covariance, anchor);
  const mean = (a + c) / 2;
  const difference = Math.hypot((a - c) / 2, b);
  const radii = [mean + difference, Math.max(0, mean - difference)].map((value) => ENLARGEMENT * Math.sqrt(value));
  // Of a sensor that is hardly determined, the ellipse would fill the screen.
  if (radii[0] > canvas.clientHeight) return;
  const [x, y] = view.project(anchor);
  context.beginPath();
  context.ellipse(x, y, Math.max(radii[0], 1), Math.max(radii[1], 1), Math.atan2(2 * b, a - c) / 2, 0, 2 * Math.PI);
  context.globalAlpha = 0.25;
  context.fillStyle = color;
  context.fill();
  context.globalAlpha = 1;
}

function fillBoard(context, corners, color, opacity) {
  tracePath(context, corners);
  context.closePath();
  context.globalAlpha = opacity;
  context.fillStyle = color;
  context.fill();
  context.globalAlpha = Math.min(1, 2.5 * opacity);
  context.strokeStyle = color;
  context.lineWidth = 1.5;
  context.stroke();
  context.globalAlpha = 1;
}

function strokePath(context, points) {
  tracePath(context, points);
  context.stroke();
}

function tracePath(context, points) {
  context.beginPath();
  points.forEach((point, index) => {
    const [x, y] = view.project(point);
    if (index) context.lineTo(x, y);
    else context.moveTo(x, y);
  });
}
