// What the cameras see, with the proposal drawn on it. Images are fetched while the person looks at them.

import { make, objectAt } from "./view.js";

const PERIOD_MS = 700;
/** Score maps are drawn in blocks of so many cells along each side. */
const BLOCK = 2;
/** How bright what no score changes is in a score map. */
const DIMMED = 0.4;
/** A block has a score worth seeing where one of red, green and blue differs from the dimmed heightmap by more. */
const SCORED = 40;

/** Where a lens shows an ideal image point (x / z, y / z), by the models of sensor_msgs/CameraInfo. */
function throughLens(model, d, u, v) {
  const r2 = u * u + v * v;
  if (model === "equidistant") {
    const [k1, k2, k3, k4] = d;
    const r = Math.sqrt(r2);
    if (r < 1e-9) return [u, v];
    const angle = Math.atan(r);
    const a2 = angle * angle;
    const scale = (angle * (1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))) / r;
    return [u * scale, v * scale];
  }
  const [k1, k2, p1, p2, k3, k4 = 0, k5 = 0, k6 = 0] = d;
  const radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)));
  return [u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u), v * radial + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v];
}

/** World position to pixel, through the lens; nothing behind the camera. */
function project({ pose, fx_px, fy_px, cx_px, cy_px, distortion_model, distortion }, point) {
  const to = point.map((value, axis) => value - pose[axis][3]);
  const [x, y, z] = [0, 1, 2].map((col) => pose[0][col] * to[0] + pose[1][col] * to[1] + pose[2][col] * to[2]);
  if (z <= 0.01) return null;
  const [u, v] = throughLens(distortion_model, distortion, x / z, y / z);
  return [fx_px * u + cx_px, fy_px * v + cy_px];
}

/** Height of the heightmap's cell under a position [m]. */
function heightAt(map, picture, { x_m, y_m }) {
  const [row, col] = [Math.floor((y_m - map.origin_y_m) / map.pixel_size_m), Math.floor((x_m - map.origin_x_m) / map.pixel_size_m)];
  return picture.height_m[row * map.cols + col] ?? 0;
}

function drawOn(context, camera, map, picture, { pick, place }) {
  const [pickAt, placeAt] = [[pick.x_m, pick.y_m, heightAt(map, picture, pick)], [place.x_m, place.y_m, heightAt(map, picture, place)]];
  const turn = place.yaw_rad - pick.yaw_rad;
  const [cos, sin] = [Math.cos(turn), Math.sin(turn)];
  const trace = (points) => {
    const pixels = points.map((point) => project(camera, point));
    if (pixels.includes(null)) return false;
    context.beginPath();
    pixels.forEach(([x, y], index) => (index ? context.lineTo(x, y) : context.moveTo(x, y)));
    return true;
  };
  const line = (points, color) => {
    if (!trace(points)) return;
    context.strokeStyle = "#000b";
    context.lineWidth = 7;
    context.stroke();
    context.strokeStyle = color;
    context.lineWidth = 3;
    context.stroke();
  };
  // The object at its new pose, on what lies there.
  context.fillStyle = "#5cd6c066";
  for (const [row, first, last] of objectAt(map, picture, pick.x_m, pick.y_m)) {
    const corner = (r, c) => {
      const [x, y] = [c * map.pixel_size_m, r * map.pixel_size_m];
      return [place.x_m + cos * x - sin * y, place.y_m + sin * x + cos * y, placeAt[2]];
    };
    if (trace([corner(row, first), corner(row, last), corner(row + 1, last), corner(row + 1, first)])) context.fill();
  }
  const ring = Array.from({ length: 25 }, (_, index) => {
    const angle = (2 * Math.PI * index) / 24;
    return [pickAt[0] + 0.016 * Math.cos(angle), pickAt[1] + 0.016 * Math.sin(angle), pickAt[2]];
  });
  const arm = (x, y) => [placeAt[0] + x, placeAt[1] + y, placeAt[2]];
  line(ring, "#ffd166");
  line([arm(-0.02, 0), arm(0.02, 0)], "#5cd6c0");
  line([arm(0, -0.02), arm(0, 0.02)], "#5cd6c0");
  line([arm(0, 0), arm(0.05 * cos, 0.05 * sin)], "#5cd6c0");
}

/** Score maps lie over the heightmap's surface. */
function drawScores(context, camera, map, picture, { rgb }) {
  const size_m = BLOCK * map.pixel_size_m;
  context.globalAlpha = 0.75;
  for (let row = 0; row + BLOCK <= map.rows; row += BLOCK) {
    for (let col = 0; col + BLOCK <= map.cols; col += BLOCK) {
      const cell = row * map.cols + col;
      const [r, g, b] = rgb.subarray(3 * cell, 3 * cell + 3);
      const change = (value, part) => Math.abs(value - DIMMED * picture.rgb[3 * cell + part]);
      if (Math.max(change(r, 0), change(g, 1), change(b, 2)) < SCORED) continue;
      const [x, y, z] = [map.origin_x_m + col * map.pixel_size_m, map.origin_y_m + row * map.pixel_size_m, picture.height_m[cell]];
      const corners = [[x, y, z], [x + size_m, y, z], [x + size_m, y + size_m, z], [x, y + size_m, z]].map((corner) => project(camera, corner));
      if (corners.includes(null)) continue;
      context.fillStyle = `rgb(${r},${g},${b})`;
      context.beginPath();
      corners.forEach(([u, v], index) => (index ? context.lineTo(u, v) : context.moveTo(u, v)));
      context.fill();
    }
  }
  context.globalAlpha = 1;
}

/** The camera views in a `details` element. */
export class CameraViews {
  #api;
  #details;
  #list;
  #views = new Map();
  #proposal = null;
  #scores = null;
  #shown = "";
  #timer = 0;

  constructor(api, details, list) {
    [this.#api, this.#details, this.#list] = [api, details, list];
    details.addEventListener("toggle", () => this.#poll());
  }

  /**
   * What is drawn on the images: the heightmap, its picture, and pick and place; nothing without a proposal. And a score map, where
   * there is one.
   */
  show(map, picture, proposal, scores) {
    const shown = JSON.stringify([picture?.number, proposal?.pick, proposal?.place, scores?.key]);
    if (shown === this.#shown) return;
    this.#shown = shown;
    this.#scores = map && picture && scores?.rows === map.rows && scores.cols === map.cols ? { map, picture, scores } : null;
    this.#proposal = map && picture && proposal?.pick && proposal.place ? { map, picture, proposal } : null;
    for (const view of this.#views.values()) this.#draw(view);
  }

  async #poll() {
    clearTimeout(this.#timer);
    if (!this.#details.open) return;
    const cameras = await this.#api.get("cameras").catch(() => []);
    for (const camera of cameras) {
      let view = this.#views.get(camera.name);
      if (!view) {
        const canvas = make("canvas", {});
        canvas.setAttribute("role", "img");
        canvas.setAttribute("aria-label", `What the ${camera.name} camera sees`);
        view = { canvas, number: 0 };
        this.#views.set(camera.name, view);
        this.#list.append(make("figure", {}, make("figcaption", { textContent: `Camera ${camera.name}` }), canvas));
      }
      view.camera = camera;
      if (camera.number !== view.number) {
        const image = await this.#api.image(`cameras/${camera.name}`).catch(() => null);
        if (image) Object.assign(view, image);
        this.#draw(view);
      }
    }
    this.#timer = setTimeout(() => this.#poll(), PERIOD_MS);
  }

  #draw({ canvas, image, camera }) {
    if (!image) return;
    [canvas.width, canvas.height] = [image.width, image.height];
    const context = canvas.getContext("2d");
    context.putImageData(image, 0, 0);
    if (this.#proposal && camera.pose) drawOn(context, camera, this.#proposal.map, this.#proposal.picture, this.#proposal.proposal);
    // Over the marks: the highest scores lie where these are.
    if (this.#scores && camera.pose) drawScores(context, camera, this.#scores.map, this.#scores.picture, this.#scores.scores);
  }
}
