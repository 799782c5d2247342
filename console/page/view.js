// Heightmaps as pictures. The robot stands below the picture and looks up: x up, y to the left.

const SVG = "http://www.w3.org/2000/svg";
/** Length of the hand that shows the turn, in cells. */
const HAND = 14;
/** Heights differ when they do by more [m]. */
const HEIGHT_DIFFERS_M = 0.005;
/** Colours differ when one of red, green and blue does by more. */
const COLOR_DIFFERS = 40;
/** Where the object under the cursor ends: a step in height [m], and its largest reach [m]. */
const EDGE_M = 0.008;
const REACH_M = 0.2;
/** Cells belong to another object when one of red, green and blue differs by more. */
const OTHER_OBJECT = 60;
const RAMP = [[24, 22, 66], [50, 90, 142], [38, 150, 140], [122, 201, 90], [253, 231, 76]];

/** World position to picture, in cells. */
export function toPicture(map, x_m, y_m) {
  return [map.rows - (y_m - map.origin_y_m) / map.pixel_size_m, map.cols - (x_m - map.origin_x_m) / map.pixel_size_m];
}

/** World position of a pointer event on a board. */
export function pointed(map, svg, event) {
  const box = svg.getBoundingClientRect();
  const [u, v] = [((event.clientX - box.left) / box.width) * map.rows, ((event.clientY - box.top) / box.height) * map.cols];
  return toWorld(map, Math.min(Math.max(u, 0.5), map.rows - 0.5), Math.min(Math.max(v, 0.5), map.cols - 0.5));
}

/** Picture, in cells, to world position. */
export function toWorld(map, u, v) {
  return [map.origin_x_m + (map.cols - v) * map.pixel_size_m, map.origin_y_m + (map.rows - u) * map.pixel_size_m];
}

/** Where the hand that shows the turn of a correction ends, in the world frame. */
export function handTip(map, { pick, place }) {
  const [turn, length_m] = [place.yaw_rad - pick.yaw_rad, HAND * map.pixel_size_m];
  return [place.x_m + length_m * Math.cos(turn), place.y_m + length_m * Math.sin(turn)];
}

/** A colour as a pixel of an image, opaque. */
const pixelOf = (r, g, b) => ((255 << 24) | (b << 16) | (g << 8) | r) >>> 0;

/** Pixels from the lowest to the highest. */
const RAMP_PIXELS = Uint32Array.from({ length: 256 }, (_, index) => {
  const at = Math.min(index / 255, 0.9999) * (RAMP.length - 1);
  const [low, high] = [RAMP[Math.floor(at)], RAMP[Math.floor(at) + 1]];
  return pixelOf(...low.map((value, part) => Math.round(value + (high[part] - value) * (at % 1))));
});
const [TO_COME, TO_GO, RECOLORED] = [pixelOf(255, 160, 40), pixelOf(90, 160, 255), pixelOf(224, 110, 224)];

/** Draws a heightmap; `other` is what it is compared with. Returns the share of cells that differ, in mode difference. */
export function draw(canvas, picture, mode, other) {
  const { rows, cols, rgb, height_m } = picture;
  if (canvas.width !== rows || canvas.height !== cols) Object.assign(canvas, { width: rows, height: cols });
  const context = canvas.getContext("2d");
  const image = context.createImageData(rows, cols);
  const pixels = new Uint32Array(image.data.buffer);
  let highest = 0.02;
  if (mode === "height") for (const height of height_m) highest = Math.max(highest, height);
  const comparable = mode === "difference" && other?.rows === rows && other.cols === cols;
  let different = 0;
  for (let row = 0; row < rows; row++) {
    for (let col = 0; col < cols; col++) {
      const cell = row * cols + col;
      const r = rgb[3 * cell], g = rgb[3 * cell + 1], b = rgb[3 * cell + 2];
      let pixel;
      if (mode === "height") {
        pixel = RAMP_PIXELS[Math.round((255 * Math.min(Math.max(height_m[cell], 0), highest)) / highest)];
      } else if (comparable) {
        const rise = other.height_m[cell] - height_m[cell];
        const change = Math.max(Math.abs(other.rgb[3 * cell] - r), Math.abs(other.rgb[3 * cell + 1] - g), Math.abs(other.rgb[3 * cell + 2] - b));
        pixel = rise > HEIGHT_DIFFERS_M ? TO_COME : rise < -HEIGHT_DIFFERS_M ? TO_GO : change > COLOR_DIFFERS ? RECOLORED : 0;
        if (pixel) different++;
        else pixel = pixelOf((r + g + b) / 12, (r + g + b) / 12, (r + g + b) / 12);
      } else {
        pixel = pixelOf(r, g, b);
      }
      pixels[(cols - 1 - col) * rows + rows - 1 - row] = pixel;
    }
  }
  context.putImageData(image, 0, 0);
  return different / (rows * cols);
}

/** Cells of the object under a world position, by height and colour: [row, first col, last col], relative to the position, in cells. */
export function objectAt(map, picture, x_m, y_m) {
  const { rows, cols, rgb, height_m } = picture;
  const [startRow, startCol] = [Math.floor((y_m - map.origin_y_m) / map.pixel_size_m), Math.floor((x_m - map.origin_x_m) / map.pixel_size_m)];
  const start = startRow * cols + startCol;
  if (!(startRow >= 0 && startRow < rows && startCol >= 0 && startCol < cols) || height_m[start] < EDGE_M / 2) return [];
  const reach = REACH_M / map.pixel_size_m;
  const seen = new Set([start]);
  const open = [start];
  while (open.length) {
    const cell = open.pop();
    const [row, col] = [Math.floor(cell / cols), cell % cols];
    for (const [nextRow, nextCol] of [[row - 1, col], [row + 1, col], [row, col - 1], [row, col + 1]]) {
      const next = nextRow * cols + nextCol;
      if (nextRow < 0 || nextRow >= rows || nextCol < 0 || nextCol >= cols || seen.has(next)) continue;
      if (Math.hypot(nextRow - startRow, nextCol - startCol) > reach) continue;
      if (height_m[next] < EDGE_M / 2 || Math.abs(height_m[next] - height_m[cell]) > EDGE_M) continue;
      if ([0, 1, 2].some((part) => Math.abs(rgb[3 * next + part] - rgb[3 * start + part]) > OTHER_OBJECT)) continue;
      seen.add(next);
      open.push(next);
    }
  }
  // Neighbours in a row are one rectangle.
  const cells = [...seen].sort((a, b) => a - b);
  const runs = [];
  for (const cell of cells) {
    const [row, col] = [Math.floor(cell / cols), cell % cols];
    const last = runs.at(-1);
    if (last && last[0] === row && last[2] === col - 1) last[2] = col;
    else runs.push([row, col, col]);
  }
  const [rowAt, colAt] = [(y_m - map.origin_y_m) / map.pixel_size_m, (x_m - map.origin_x_m) / map.pixel_size_m];
  return runs.map(([row, first, last]) => [row - rowAt, first - colAt, last + 1 - colAt]);
}

/** The middle of the object under a world position; the position itself where there is none. */
export function middleOfObject(map, picture, x_m, y_m) {
  let [area, rowSum, colSum] = [0, 0, 0];
  for (const [row, first, last] of objectAt(map, picture, x_m, y_m)) {
    area += last - first;
    rowSum += (last - first) * (row + 0.5);
    colSum += ((last - first) * (first + last)) / 2;
  }
  if (!area) return [x_m, y_m];
  return [x_m + (colSum / area) * map.pixel_size_m, y_m + (rowSum / area) * map.pixel_size_m];
}

export function make(tag, properties, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

function element(name, attributes, parent, text) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text) made.textContent = text;
  parent?.append(made);
  return made;
}

function mark(svg, tag, kind, attributes) {
  element(tag, { ...attributes, class: "halo", "stroke-width": 4.5 }, svg);
  element(tag, { ...attributes, class: kind, "stroke-width": 2 }, svg);
}

/** The outline of the object under a world position, moved to another one and turned. */
function outline(map, picture, from, to, turn, svg) {
  const [u, v] = toPicture(map, to.x_m, to.y_m);
  const [cos, sin] = [Math.cos(turn), Math.sin(turn)];
  const corner = (row, col) => {
    // A turn about the world's z axis, from x (columns) to y (rows).
    const [x, y] = [cos * col - sin * row, sin * col + cos * row];
    return `${(u - y).toFixed(2)} ${(v - x).toFixed(2)}`;
  };
  const path = objectAt(map, picture, from.x_m, from.y_m).map(
    ([row, first, last]) => `M${corner(row, first)}L${corner(row, last)}L${corner(row + 1, last)}L${corner(row + 1, first)}Z`,
  );
  element("path", { d: path.join(""), class: "object" }, svg);
}

/** Shows the object that a click would pick; nothing where there is none. */
export function drawObject(svg, map, picture, x_m, y_m) {
  svg.setAttribute("viewBox", `0 0 ${map.rows} ${map.cols}`);
  svg.replaceChildren();
  const at = { x_m, y_m };
  outline(map, picture, at, at, 0, svg);
}

/** Draws pick, place, turn, and the object at its new pose; `handle`: the turn can be dragged. */
export function drawProposal(svg, map, picture, proposal, handle = false) {
  svg.setAttribute("viewBox", `0 0 ${map.rows} ${map.cols}`);
  svg.replaceChildren();
  if (!proposal?.pick) return;
  const { pick, place } = proposal;
  const [pickU, pickV] = toPicture(map, pick.x_m, pick.y_m);
  const label = (text, u, v) => element("text", { x: Math.min(u + 8, map.rows - 30), y: Math.max(v - 7, 9), class: "mark" }, svg, text);
  if (!place) {
    if (picture) outline(map, picture, pick, pick, 0, svg);
    mark(svg, "circle", "pick", { cx: pickU, cy: pickV, r: 6 });
    return label("Pick", pickU, pickV);
  }
  const [placeU, placeV] = toPicture(map, place.x_m, place.y_m);
  const turn = place.yaw_rad - pick.yaw_rad;
  if (picture) outline(map, picture, pick, place, turn, svg);
  mark(svg, "line", "way", { x1: pickU, y1: pickV, x2: placeU, y2: placeV, "stroke-dasharray": "5 3" });
  mark(svg, "circle", "pick", { cx: pickU, cy: pickV, r: 6 });
  mark(svg, "path", "place", { d: `M${placeU - 6} ${placeV}h12M${placeU} ${placeV - 6}v12` });
  // The turn: a hand that points where the object's x axis points.
  const [handU, handV] = [placeU - HAND * Math.sin(turn), placeV - HAND * Math.cos(turn)];
  mark(svg, "line", "place", { x1: placeU, y1: placeV, x2: handU, y2: handV });
  if (handle) mark(svg, "circle", "place", { cx: handU, cy: handV, r: 3.5 });
  label("Pick", pickU, pickV);
  label("Place", placeU, placeV);
}

/** Draws where the world's axes lie: a mark each 100 mm along the edges. */
export function drawAxes(svg, map) {
  svg.setAttribute("viewBox", `0 0 ${map.rows} ${map.cols}`);
  svg.replaceChildren();
  const marks = (begin_m, cells) => {
    const [first, last] = [begin_m, begin_m + cells * map.pixel_size_m].map((edge_m) => 10 * edge_m);
    // Not at the very edges, where a number would be cut off.
    const inside = (mark) => mark > first + 0.3 && mark < last - 0.3;
    return Array.from({ length: Math.floor(last) - Math.ceil(first) + 1 }, (_, index) => Math.ceil(first) + index).filter(inside);
  };
  for (const [index, mark] of marks(map.origin_x_m, map.cols).entries()) {
    const [, v] = toPicture(map, mark / 10, map.origin_y_m);
    element("line", { x1: 0, x2: 4, y1: v, y2: v }, svg);
    element("text", { x: 6, y: v + 3 }, svg, index ? `${100 * mark}` : `x ${100 * mark} mm`);
  }
  for (const [index, mark] of marks(map.origin_y_m, map.rows).entries()) {
    const [u] = toPicture(map, map.origin_x_m, mark / 10);
    element("line", { x1: u, x2: u, y1: map.cols, y2: map.cols - 4 }, svg);
    // Not where the numbers of the other axis stand.
    if (mark % 2 === 0 && u > 45) element("text", { x: u, y: map.cols - 6, "text-anchor": "middle" }, svg, index > 1 ? `${100 * mark}` : `y ${100 * mark} mm`);
  }
}

/** A canvas with a drawing over it; `axes` is where axes may be drawn. */
export function board(container, label) {
  const canvas = document.createElement("canvas");
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", label);
  const svg = element("svg", { "aria-hidden": "true", preserveAspectRatio: "none" });
  const axes = element("svg", { "aria-hidden": "true", preserveAspectRatio: "none", class: "axes" });
  container.replaceChildren(canvas, axes, svg);
  return { canvas, svg, axes };
}
