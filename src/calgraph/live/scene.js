// Sensors with poses: of rigs with the boards of the captures and the next one, in a parallel projection that orbits
// the middle of the scene; of networks from above, on the floor with its walls and walks. Coordinates: z up, m.

import { byId } from "./dom.js";

const COLORS = { good: "#3be28d", weak: "#ffbd45", unobservable: "#ff7369" };
const ROOT = "#ffffff";
const BOARD = "#8fa3b8";
const SUGGESTED = "#6bbcff";
const WALKED = "#1f4a78";
const WANTED = "#9a6c18";
const WALL = "#b8c4d0";
// Standard deviations of some mm would not be visible in a view of some m.
const ENLARGEMENT = 20;
const SIZE = 0.25;
// From above: radius of a scanner and of its tolerance, px; largest one of an error (95 %), over that of the tolerance.
const RADIUS = 11;
const LARGEST_ERROR = 3.5;
const SIGMAS = 1.96;
const TURN_PER_PIXEL = 0.008;
const TURN_PER_KEY = 0.15;
const ZOOM_PER_KEY = 1.2;
const ZOOM_PER_PIXEL = 1.0015;
// From slightly below the floor to straight down, rad.
const ELEVATIONS = [-0.3, 1.55];

const canvas = byId("scene");
const context = canvas.getContext("2d");
const FROM_ABOVE = { azimuth: -Math.PI / 2, elevation: Math.PI / 2, zoom: 1 };
let view = { azimuth: -2.2, elevation: 0.6, zoom: 1 };
let scene = null;
let root = "";
// m.
let tolerance = 0;
// Lowest and highest coordinates of sensors, boards and floor.
let bounds = [[-1, -1, -1], [1, 1, 1]];

/** Shows the scene of a state, if it is another one. */
export function showScene(state) {
  byId("no-scene").hidden = Boolean(state.scene);
  if (state.scene === scene) return;
  [scene, root, tolerance] = [state.scene, state.root, state.tolerance_mm / 1000];
  if (scene?.floor) view = FROM_ABOVE;
  const origins = scene?.sensors.map((sensor) => originOf(sensor.T_root_sensor)) ?? [];
  const walls = scene?.floor?.walls.map(([x, y]) => [x, y, 0]) ?? [];
  const points = [...origins, ...walls, ...(scene?.boards.flat() ?? []), ...(scene?.suggested ?? [])];
  if (points.length) {
    bounds = [Math.min, Math.max].map((choose) => [0, 1, 2].map(
      (axis) => points.reduce((found, point) => choose(found, point[axis]), points[0][axis]),
    ));
  }
  draw();
}

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const originOf = (pose) => pose.slice(0, 3).map((row) => row[3]);
const colorOf = (sensor) => (sensor.name === root ? ROOT : (COLORS[sensor.grade] ?? BOARD));

/** Pixels per m: at the first zoom, nine tenths of the shorter side show all points from any side. */
function scale() {
  const size = bounds[1].map((value, axis) => Math.max(1, value - bounds[0][axis]));
  const [width, height] = view === FROM_ABOVE ? size : [Math.hypot(...size), Math.hypot(...size)];
  return view.zoom * 0.9 * Math.min(canvas.clientWidth / width, canvas.clientHeight / height);
}

/** Directions of the screen in the scene: right, and down. */
function axes() {
  const [sa, ca] = [Math.sin(view.azimuth), Math.cos(view.azimuth)];
  const [se, ce] = [Math.sin(view.elevation), Math.cos(view.elevation)];
  return [[-sa, ca, 0], [se * ca, se * sa, -ce]];
}

function project(point) {
  const offset = point.map((value, axis) => value - (bounds[0][axis] + bounds[1][axis]) / 2);
  const [right, down] = axes().map((axis) => dot(axis, offset) * scale());
  return [canvas.clientWidth / 2 + right, canvas.clientHeight / 2 + down];
}

function draw() {
  if (!canvas.clientWidth) return;
  const ratio = window.devicePixelRatio || 1;
  [canvas.width, canvas.height] = [canvas.clientWidth, canvas.clientHeight].map((size) => Math.round(size * ratio));
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.lineJoin = "round";
  if (!scene) return;
  drawGrid();
  if (scene.floor) drawFloor(scene.floor);
  for (const board of scene.boards) fillBoard(board, BOARD, 0.14);
  if (scene.suggested) fillBoard(scene.suggested, SUGGESTED, 0.4);
  scene.sensors.forEach(drawSensor);
  drawNames();
}

/** A grid of 1 m at the height of the lowest point. */
function drawGrid() {
  const [low, high] = bounds;
  const [x0, y0, x1, y1] = [Math.floor(low[0]) - 1, Math.floor(low[1]) - 1, Math.ceil(high[0]) + 1, Math.ceil(high[1]) + 1];
  // Scenes of some km, which only wrong poses make, have no grid.
  if (x1 - x0 > 60 || y1 - y0 > 60) return;
  context.strokeStyle = "#1d2630";
  context.lineWidth = 1;
  for (let x = x0; x <= x1; x += 1) strokePath([[x, y0, low[2]], [x, y1, low[2]]]);
  for (let y = y0; y <= y1; y += 1) strokePath([[x0, y, low[2]], [x1, y, low[2]]]);
}

function drawFloor({ origin, cell, walked, wanted, walls }) {
  const cells = (chosen) => chosen.flatMap((column, i) => column.flatMap((isChosen, j) => (isChosen ? [[i, j]] : [])));
  // Slightly too wide, so that no gap shows between cells.
  const width = cell * scale() + 0.5;
  const squares = (color, points, size) => {
    context.fillStyle = color;
    for (const [x, y] of points) context.fillRect(...project([x, y, 0]).map((middle) => middle - size / 2), size, size);
  };
  const middles = (chosen) => cells(chosen).map((place) => place.map((index, axis) => origin[axis] + cell * (index + 0.5)));
  squares(WANTED, middles(wanted), width);
  squares(WALKED, middles(walked), width);
  squares(WALL, walls, 2);
}

function drawSensor(sensor) {
  context.strokeStyle = colorOf(sensor);
  context.lineWidth = 2;
  outlineOf(sensor).forEach(strokePath);
  if (sensor.name !== root && sensor.covariance) drawUncertainty(sensor);
}

/** Lines of a sensor: a camera's frustum along z; a disc around z with the x axis of a scanner. */
function outlineOf({ kind, T_root_sensor: pose, field_of_view: field }) {
  const at = (...point) => pose.slice(0, 3).map((row) => dot(row, point) + row[3]);
  if (kind === "camera") {
    // Wide fields are drawn up to 120 degrees: beyond, the frustum is too flat to be recognized.
    const [x, y] = (field ?? [1, 0.75]).map((angle) => SIZE * Math.tan(Math.min(angle, 2.1) / 2));
    const corners = [at(-x, -y, SIZE), at(x, -y, SIZE), at(x, y, SIZE), at(-x, y, SIZE)];
    return [[...corners, corners[0]], ...corners.map((corner) => [at(0, 0, 0), corner])];
  }
  const radius = scene.floor ? RADIUS / scale() : SIZE / 2;
  const angles = Array.from({ length: 33 }, (_, index) => (index * Math.PI) / 16);
  const circle = (z) => angles.map((angle) => at(Math.cos(angle) * radius, Math.sin(angle) * radius, z));
  const circles = kind === "lidar3d" ? [circle(-SIZE / 4), circle(SIZE / 4)] : [circle(0)];
  return [...circles, [at(0, 0, 0), at(2 * radius, 0, 0)]];
}

/**
 * The ellipsoid of one standard deviation, enlarged, as the ellipse that it is on the screen; from above, that of 95 %
 * at the scale at which the circle of the scanner is the tolerance.
 */
function drawUncertainty(sensor) {
  const [right, down] = axes();
  const project2 = (u, v) => dot(u, sensor.covariance.map((row) => dot(row, v))) * scale() ** 2;
  const [a, b, c] = [project2(right, right), project2(right, down), project2(down, down)];
  const mean = (a + c) / 2;
  const difference = Math.hypot((a - c) / 2, b);
  const enlargement = scene.floor ? (SIGMAS * RADIUS) / (tolerance * scale()) : ENLARGEMENT;
  const limit = scene.floor ? LARGEST_ERROR * RADIUS : Infinity;
  const radii = [mean + difference, Math.max(0, mean - difference)].map(
    (value) => Math.min(limit, enlargement * Math.sqrt(value)),
  );
  // Of a sensor that is hardly determined, the ellipse would fill the screen.
  if (radii[0] > canvas.clientHeight) return;
  const [x, y] = project(originOf(sensor.T_root_sensor));
  context.beginPath();
  context.ellipse(x, y, Math.max(radii[0], 1), Math.max(radii[1], 1), Math.atan2(2 * b, a - c) / 2, 0, 2 * Math.PI);
  fill(colorOf(sensor), 0.25);
}

function fillBoard(corners, color, opacity) {
  tracePath(corners);
  context.closePath();
  fill(color, opacity);
  context.globalAlpha = Math.min(1, 2.5 * opacity);
  context.strokeStyle = color;
  context.lineWidth = 1.5;
  context.stroke();
  context.globalAlpha = 1;
}

function fill(color, opacity) {
  context.globalAlpha = opacity;
  context.fillStyle = color;
  context.fill();
  context.globalAlpha = 1;
}

function strokePath(points) {
  tracePath(points);
  context.stroke();
}

function tracePath(points) {
  context.beginPath();
  for (const point of points) context.lineTo(...project(point));
}

/** Names beside their sensors, one below the other where they would cover each other. */
function drawNames() {
  context.font = "600 14px system-ui, sans-serif";
  context.lineWidth = 4;
  context.strokeStyle = "#0b0f14";
  const placed = [];
  const names = scene.sensors.map((sensor) => ({ sensor, at: project(originOf(sensor.T_root_sensor)) }));
  for (const { sensor, at } of names.sort((a, b) => a.at[1] - b.at[1])) {
    const [x, width] = [at[0] + 14, context.measureText(sensor.name).width];
    const beside = placed.filter((other) => x <= other.x + other.width && other.x <= x + width);
    placed.push({ sensor, x, y: Math.max(at[1] - 8, ...beside.map((other) => other.y + 18)), width });
  }
  // Those below the lower border move up, all by as much.
  const below = Math.max(0, ...placed.map(({ y }) => y + 6 - canvas.clientHeight));
  for (const { sensor, x, y } of placed) {
    context.strokeText(sensor.name, x, y - below);
    context.fillStyle = colorOf(sensor);
    context.fillText(sensor.name, x, y - below);
  }
}

function turn(across, along) {
  view.azimuth -= across;
  view.elevation = Math.min(ELEVATIONS[1], Math.max(ELEVATIONS[0], view.elevation + along));
  draw();
}

function magnify(factor) {
  view.zoom = Math.min(20, Math.max(0.2, view.zoom * factor));
  draw();
}

const pointers = new Map();
const distance = () => {
  const [a, b] = [...pointers.values()];
  return Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);
};
canvas.addEventListener("pointerdown", (event) => {
  canvas.setPointerCapture(event.pointerId);
  pointers.set(event.pointerId, event);
});
canvas.addEventListener("pointermove", (event) => {
  const last = pointers.get(event.pointerId);
  if (!last) return;
  const before = pointers.size === 2 ? distance() : 0;
  pointers.set(event.pointerId, event);
  if (before) magnify(distance() / before);
  else turn((event.clientX - last.clientX) * TURN_PER_PIXEL, (event.clientY - last.clientY) * TURN_PER_PIXEL);
});
for (const end of ["pointerup", "pointercancel"]) {
  canvas.addEventListener(end, (event) => pointers.delete(event.pointerId));
}
canvas.addEventListener("wheel", (event) => {
  event.preventDefault();
  magnify(ZOOM_PER_PIXEL ** -event.deltaY);
}, { passive: false });
const keys = {
  ArrowLeft: () => turn(-TURN_PER_KEY, 0),
  ArrowRight: () => turn(TURN_PER_KEY, 0),
  ArrowUp: () => turn(0, TURN_PER_KEY),
  ArrowDown: () => turn(0, -TURN_PER_KEY),
  "+": () => magnify(ZOOM_PER_KEY),
  "-": () => magnify(1 / ZOOM_PER_KEY),
};
canvas.addEventListener("keydown", (event) => {
  if (!keys[event.key] || view === FROM_ABOVE) return;
  event.preventDefault();
  keys[event.key]();
});
new ResizeObserver(draw).observe(canvas);
