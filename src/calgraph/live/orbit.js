// A view that orbits a point: projection, and what the pointer, the wheel and keys do. Coordinates: z up, m.

const TURN_PER_PIXEL = 0.008;
const TURN_PER_KEY = 0.15;
const ZOOM_PER_KEY = 1.2;
const ZOOM_PER_PIXEL = 1.0015;
// From slightly below the floor to straight down, rad.
const ELEVATIONS = [-0.3, 1.55];

/** A parallel projection of the canvas; `redraw` is called when it has changed. */
export function makeView(canvas, redraw) {
  let azimuth = -2.2;
  let elevation = 0.6;
  let zoom = 1;
  let center = [0, 0, 0];
  let radius = 1;
  const pointers = new Map();

  // All points lie within the radius: at the first zoom, nine tenths of the shorter side show them.
  const scale = () => (zoom * 0.45 * Math.min(canvas.clientWidth, canvas.clientHeight)) / radius;

  /** Directions of the screen in the scene: right, and down. */
  function axes() {
    const [sa, ca, se, ce] = [Math.sin(azimuth), Math.cos(azimuth), Math.sin(elevation), Math.cos(elevation)];
    return [[-sa, ca, 0], [se * ca, se * sa, -ce]];
  }

  function project(point) {
    const offset = point.map((value, index) => value - center[index]);
    const [right, down] = axes().map((axis) => dot(axis, offset) * scale());
    return [canvas.clientWidth / 2 + right, canvas.clientHeight / 2 + down];
  }

  function projectCovariance(covariance) {
    const [right, down] = axes();
    const rotated = [right, down].map((axis) => covariance.map((row) => dot(row, axis)));
    const square = scale() ** 2;
    return [dot(right, rotated[0]) * square, dot(right, rotated[1]) * square, dot(down, rotated[1]) * square];
  }

  function begin() {
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((size) => Math.round(size * ratio));
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    const context = canvas.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, canvas.clientWidth, canvas.clientHeight);
    context.lineJoin = "round";
    return context;
  }

  function frame([low, high]) {
    center = low.map((value, index) => (value + high[index]) / 2);
    radius = Math.max(0.5, Math.hypot(...high.map((value, index) => value - low[index])) / 2);
  }

  function turn(across, along) {
    azimuth -= across;
    elevation = Math.min(ELEVATIONS[1], Math.max(ELEVATIONS[0], elevation + along));
    redraw();
  }

  function magnify(factor) {
    zoom = Math.min(20, Math.max(0.2, zoom * factor));
    redraw();
  }

  const distance = () => {
    const [a, b] = [...pointers.values()];
    return Math.hypot(a.x - b.x, a.y - b.y);
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  canvas.addEventListener("pointermove", (event) => {
    const last = pointers.get(event.pointerId);
    if (!last) return;
    const before = pointers.size === 2 ? distance() : 0;
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (pointers.size === 2 && before) magnify(distance() / before);
    else turn((event.clientX - last.x) * TURN_PER_PIXEL, (event.clientY - last.y) * TURN_PER_PIXEL);
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
    if (!keys[event.key]) return;
    event.preventDefault();
    keys[event.key]();
  });
  new ResizeObserver(redraw).observe(canvas);
  return { project, projectCovariance, begin, frame };
}

/** Lowest and highest coordinates of sensors and boards. */
export function boundsOf(scene) {
  const origins = scene.frames.map((frame) => originOf(frame.pose));
  const points = [...origins, ...scene.boards.flat(), ...(scene.suggested ?? [])];
  if (!points.length) return [[-1, -1, -1], [1, 1, 1]];
  return [Math.min, Math.max].map((choose) => [0, 1, 2].map((axis) => points.reduce(
    (found, point) => choose(found, point[axis]), points[0][axis],
  )));
}

/** Lines of a sensor: a camera's frustum along z; a disc around z with the x axis of a scanner. */
export function outlineOf({ kind, pose, field_of_view: field }, size) {
  const at = (...point) => pose.slice(0, 3).map((row) => dot(row.slice(0, 3), point) + row[3]);
  const anchor = originOf(pose);
  if (kind === "camera") {
    // Wide fields are drawn up to 120 degrees: beyond, the frustum is too flat to be recognized.
    const [x, y] = (field ?? [1, 0.75]).map((angle) => size * Math.tan(Math.min(angle, 2.1) / 2));
    const corners = [at(-x, -y, size), at(x, -y, size), at(x, y, size), at(-x, y, size)];
    return { anchor, lines: [[...corners, corners[0]], ...corners.map((corner) => [anchor, corner])] };
  }
  const angles = Array.from({ length: 33 }, (_, index) => (index * Math.PI) / 16);
  const circle = (z) => angles.map((angle) => at((Math.cos(angle) * size) / 2, (Math.sin(angle) * size) / 2, z));
  const circles = kind === "lidar3d" ? [circle(-size / 4), circle(size / 4)] : [circle(0)];
  return { anchor, lines: [...circles, [anchor, at(size, 0, 0)]] };
}

const originOf = (pose) => pose.slice(0, 3).map((row) => row[3]);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
