// The robot in three dimensions, drawn from its URDF on a plain canvas: boxes and cylinders, shaded flat, far ones first.
// Lengths are in metres, angles in radians, positions in the world frame.

/** Flat sides of a cylinder. */
const SIDES = 14;
/** Heightmap cells along each side of a block of the table. */
const BLOCK = 4;
/** What is lower is the table itself [m]. */
const FLAT_M = 0.004;
/** Neighbours on the table are one face where red, green and blue differ by no more. */
const SAME_COLOR = 6;
/** Where the eye looks, how far it stands, and how wide it sees. */
const TARGET = [0.42, 0, 0.18];
const DISTANCE_M = 2.3;
const FIELD_RAD = 0.62;
const LIGHT = [0.35, -0.4, 0.85];
const FRAME_MS = 60;

const numbers = (text) => (text ?? "0 0 0").trim().split(/\s+/).map(Number);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const unit = (a) => a.map((value) => value / (Math.hypot(...a) || 1));

/** A transform: three columns of a rotation, and a translation. */
const IDENTITY = { x: [1, 0, 0], y: [0, 1, 0], z: [0, 0, 1], at: [0, 0, 0] };
const turned = (pose, [x, y, z]) => [0, 1, 2].map((row) => pose.x[row] * x + pose.y[row] * y + pose.z[row] * z);
const moved = (pose, point) => turned(pose, point).map((value, row) => value + pose.at[row]);
const chained = (a, b) => ({ x: turned(a, b.x), y: turned(a, b.y), z: turned(a, b.z), at: moved(a, b.at) });

/** A turn about an axis of length 1 (Rodrigues). */
function rotation(axis, angle) {
  const [cos, sin] = [Math.cos(angle), Math.sin(angle)];
  const column = (unitVector) => {
    const [across, along] = [cross(axis, unitVector), dot(axis, unitVector) * (1 - cos)];
    return unitVector.map((value, row) => value * cos + across[row] * sin + axis[row] * along);
  };
  return { x: column([1, 0, 0]), y: column([0, 1, 0]), z: column([0, 0, 1]), at: [0, 0, 0] };
}

/** The pose of an element's `origin`: fixed axes, roll first. */
function origin(element) {
  const [roll, pitch, yaw] = numbers(element?.getAttribute("rpy"));
  const turn = chained(chained(rotation([0, 0, 1], yaw), rotation([0, 1, 0], pitch)), rotation([1, 0, 0], roll));
  return { ...turn, at: numbers(element?.getAttribute("xyz")) };
}

function boxFaces([x, y, z]) {
  const corner = (a, b, c) => [(a * x) / 2, (b * y) / 2, (c * z) / 2];
  const faces = [];
  for (const side of [1, -1]) {
    const order = side > 0 ? [[-1, -1], [1, -1], [1, 1], [-1, 1]] : [[-1, 1], [1, 1], [1, -1], [-1, -1]];
    faces.push(order.map(([a, b]) => corner(side, a, b)), order.map(([a, b]) => corner(b, side, a)), order.map(([a, b]) => corner(a, b, side)));
  }
  return faces;
}

function cylinderFaces(radius, length) {
  const ring = (z) => Array.from({ length: SIDES }, (_, index) => {
    const angle = (2 * Math.PI * index) / SIDES;
    return [radius * Math.cos(angle), radius * Math.sin(angle), z];
  });
  const [low, high] = [ring(-length / 2), ring(length / 2)];
  const sides = low.map((corner, index) => [corner, low[(index + 1) % SIDES], high[(index + 1) % SIDES], high[index]]);
  return [...sides, high, low.toReversed()];
}

/** Links with their faces, and joints; meshes are left out. */
function readUrdf(text) {
  const robot = new DOMParser().parseFromString(text, "application/xml").querySelector("robot");
  if (!robot) throw new Error("robot_description is not a URDF");
  const child = (element, name) => [...element.children].find((one) => one.tagName === name);
  const rgba = (element) => element && numbers(element.getAttribute("rgba")).map((value) => Math.round(255 * value)).slice(0, 3);
  const materials = new Map();
  for (const material of robot.querySelectorAll("material")) {
    const color = rgba(child(material, "color"));
    if (color) materials.set(material.getAttribute("name"), color);
  }
  const links = new Map();
  const joints = [];
  for (const element of robot.children) {
    const name = element.getAttribute("name");
    if (element.tagName === "link") {
      const visuals = [...element.children].filter((one) => one.tagName === "visual").map((visual) => {
        const shape = child(visual, "geometry")?.firstElementChild;
        const number = (attribute) => Number(shape.getAttribute(attribute));
        const faces = shape?.tagName === "box" ? boxFaces(numbers(shape.getAttribute("size")))
          : shape?.tagName === "cylinder" ? cylinderFaces(number("radius"), number("length")) : [];
        const material = child(visual, "material");
        const color = material && (rgba(child(material, "color")) ?? materials.get(material.getAttribute("name")));
        return { pose: origin(child(visual, "origin")), faces, color: color ?? [160, 165, 170] };
      });
      links.set(name, visuals);
    } else if (element.tagName === "joint") {
      joints.push({
        name, type: element.getAttribute("type"), origin: origin(child(element, "origin")),
        parent: child(element, "parent").getAttribute("link"), child: child(element, "child").getAttribute("link"),
        axis: unit(child(element, "axis") ? numbers(child(element, "axis").getAttribute("xyz")) : [1, 0, 0]),
      });
    }
  }
  const children = new Set(joints.map((joint) => joint.child));
  const root = [...links.keys()].find((link) => !children.has(link));
  return { links, joints, root };
}

/** Pose of each link; joints that are not given stand at 0. */
function linkPoses({ joints, root }, positions) {
  const poses = new Map([[root, { pose: IDENTITY, fixed: true }]]);
  const open = [root];
  while (open.length) {
    const parent = open.pop();
    for (const joint of joints.filter((one) => one.parent === parent)) {
      const at = poses.get(parent);
      let pose = chained(at.pose, joint.origin);
      const position = positions[joint.name] ?? 0;
      if (joint.type === "revolute" || joint.type === "continuous") pose = chained(pose, rotation(joint.axis, position));
      else if (joint.type === "prismatic") pose = { ...pose, at: moved(pose, joint.axis.map((value) => value * position)) };
      poses.set(joint.child, { pose, fixed: at.fixed && joint.type === "fixed" });
      open.push(joint.child);
    }
  }
  return poses;
}

/** Positions at a time of a motion, between its points. */
function positionsAt({ joint_names, times_s, positions_rad }, time_s) {
  let next = times_s.findIndex((at) => at >= time_s);
  if (next < 0) next = times_s.length - 1;
  const before = Math.max(next - 1, 0);
  const span = times_s[next] - times_s[before];
  const share = span > 0 ? Math.min(Math.max((time_s - times_s[before]) / span, 0), 1) : 0;
  return Object.fromEntries(joint_names.map((name, joint) => [name,
    positions_rad[before][joint] + share * (positions_rad[next][joint] - positions_rad[before][joint])]));
}

/** Draws the robot; plays planned motions. */
export class Arm {
  #canvas;
  #context;
  #model = null;
  #motion = null;
  #path = [];
  #table = null;
  #positions = null;
  #background = null;
  #azimuth_rad = -0.85;
  #elevation_rad = 0.5;
  #playing = 0;

  /** `onTime` is told the time of the motion that is drawn [s], and whether it goes on. */
  constructor(canvas, onTime) {
    this.#canvas = canvas;
    this.#context = canvas.getContext("2d");
    this.onTime = onTime;
    canvas.addEventListener("pointerdown", (event) => {
      const turn = (to) => this.#look(-to.movementX / 150, to.movementY / 150);
      canvas.setPointerCapture(event.pointerId);
      canvas.addEventListener("pointermove", turn);
      canvas.addEventListener("pointerup", () => canvas.removeEventListener("pointermove", turn), { once: true });
    });
    canvas.addEventListener("keydown", (event) => {
      const turn = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[event.key];
      if (!turn) return;
      event.preventDefault();
      this.#look(...turn);
    });
  }

  get ready() {
    return this.#model !== null;
  }

  get playing() {
    return this.#playing !== 0;
  }

  /** Takes the URDF. */
  load(urdf) {
    this.#model = readUrdf(urdf);
    this.#background = null;
    this.#draw();
  }

  /** What lies on the table: a heightmap and where it lies. */
  setTable(map, picture) {
    this.#table = { map, picture };
    this.#background = null;
    if (!this.playing) this.#draw();
  }

  /** Where the joints are now; drawn unless a motion is shown. */
  setPositions(positions) {
    if (this.#motion || this.playing || JSON.stringify(positions) === JSON.stringify(this.#positions)) return;
    this.#positions = positions;
    this.#draw();
  }

  /** The motion to be played; nothing to show the robot as it is. */
  setMotion(motion) {
    this.stop();
    this.#motion = motion?.times_s.length ? motion : null;
    this.#path = [];
    if (this.#motion && this.#model) {
      this.#path = this.#motion.times_s.map((time_s, index) => {
        const poses = linkPoses(this.#model, Object.fromEntries(this.#motion.joint_names.map((name, joint) => [name, this.#motion.positions_rad[index][joint]])));
        const tip = poses.get("suction_tip") ?? poses.get("tool0") ?? [...poses.values()].at(-1);
        return { at: tip.pose.at, holds: time_s >= this.#motion.suction_on_s && time_s <= this.#motion.suction_off_s };
      });
      this.show(0);
    }
  }

  /** Draws the robot at a time of the motion. */
  show(time_s) {
    if (!this.#motion) return;
    this.#positions = positionsAt(this.#motion, time_s);
    this.#draw();
    this.onTime(time_s, this.playing);
  }

  /** Plays the motion as fast as the robot would carry it out. */
  play() {
    if (!this.#motion) return;
    this.stop();
    const end_s = this.#motion.times_s.at(-1);
    const begin_ms = performance.now();
    let drawn_ms = 0;
    const frame = (now_ms) => {
      const time_s = Math.max(now_ms - begin_ms, 0) / 1000;
      const over = time_s >= end_s;
      this.#playing = over ? 0 : requestAnimationFrame(frame);
      if (over || now_ms - drawn_ms >= FRAME_MS) {
        drawn_ms = now_ms;
        this.show(Math.min(time_s, end_s));
      }
    };
    this.#playing = requestAnimationFrame(frame);
  }

  stop() {
    cancelAnimationFrame(this.#playing);
    this.#playing = 0;
  }

  #look(azimuth, elevation) {
    this.#azimuth_rad += azimuth;
    this.#elevation_rad = Math.min(Math.max(this.#elevation_rad + elevation, 0.08), 1.45);
    this.#background = null;
    this.#draw();
  }

  /** The eye: its position and axes (right, up, to the eye). */
  #eye() {
    const [azimuth, elevation] = [this.#azimuth_rad, this.#elevation_rad];
    const back = [Math.cos(elevation) * Math.cos(azimuth), Math.cos(elevation) * Math.sin(azimuth), Math.sin(elevation)];
    const right = unit(cross([0, 0, 1], back));
    return { at: TARGET.map((value, axis) => value + DISTANCE_M * back[axis]), right, up: cross(back, right), back };
  }

  #project(eye, point) {
    const to = minus(point, eye.at);
    const depth = -dot(to, eye.back);
    const scale = this.#canvas.height / (2 * Math.tan(FIELD_RAD / 2)) / Math.max(depth, 0.05);
    return [this.#canvas.width / 2 + dot(to, eye.right) * scale, this.#canvas.height / 2 - dot(to, eye.up) * scale, depth];
  }

  #fill(context, eye, corners, color, shade) {
    context.beginPath();
    for (const [index, corner] of corners.entries()) {
      const [x, y] = this.#project(eye, corner);
      if (index) context.lineTo(x, y);
      else context.moveTo(x, y);
    }
    context.closePath();
    const style = `rgb(${color.map((value) => Math.round(Math.min(value * shade, 255))).join(",")})`;
    context.fillStyle = style;
    context.strokeStyle = style;
    context.fill();
    context.stroke();
  }

  /** Draws faces that look at the eye, far ones first. */
  #solids(context, eye, poses, wanted) {
    const faces = [];
    for (const [name, visuals] of this.#model.links) {
      const link = poses.get(name);
      if (!link || !wanted(link)) continue;
      for (const visual of visuals) {
        const pose = chained(link.pose, visual.pose);
        for (const face of visual.faces) {
          const corners = face.map((corner) => moved(pose, corner));
          const normal = unit(cross(minus(corners[1], corners[0]), minus(corners[2], corners[1])));
          if (dot(normal, minus(eye.at, corners[0])) <= 0) continue;
          const middle = [0, 1, 2].map((axis) => corners.reduce((sum, corner) => sum + corner[axis], 0) / corners.length);
          faces.push({ corners, color: visual.color, shade: 0.6 + 0.55 * Math.max(dot(normal, LIGHT), 0), far: Math.hypot(...minus(middle, eye.at)) });
        }
      }
    }
    faces.sort((a, b) => b.far - a.far);
    for (const { corners, color, shade } of faces) this.#fill(context, eye, corners, color, shade);
  }

  /** What lies on the table, as blocks; first the table itself, of which neighbours of nearly the same colour are one face. */
  #blocks(context, eye) {
    if (!this.#table?.picture) return;
    const { map, picture } = this.#table;
    const edge = (index, start) => start + index * map.pixel_size_m;
    const blocks = [];
    for (let row = 0; row + BLOCK <= map.rows; row += BLOCK) {
      const [y0, y1] = [edge(row, map.origin_y_m), edge(row + BLOCK, map.origin_y_m)];
      let flat = null;
      const finish = () => {
        if (flat) this.#fill(context, eye, [[flat.x0, y0, 0], [flat.x1, y0, 0], [flat.x1, y1, 0], [flat.x0, y1, 0]], flat.color, 1);
        flat = null;
      };
      for (let col = 0; col + BLOCK <= map.cols; col += BLOCK) {
        const cell = (row + BLOCK / 2) * map.cols + col + BLOCK / 2;
        const color = picture.rgb.subarray(3 * cell, 3 * cell + 3);
        const [x0, x1, height] = [edge(col, map.origin_x_m), edge(col + BLOCK, map.origin_x_m), picture.height_m[cell]];
        if (height > FLAT_M) {
          finish();
          blocks.push({ x0, x1, y0, y1, height, color, far: Math.hypot((x0 + x1) / 2 - eye.at[0], (y0 + y1) / 2 - eye.at[1], eye.at[2]) });
          continue;
        }
        if (flat && [0, 1, 2].some((part) => Math.abs(flat.color[part] - color[part]) > SAME_COLOR)) finish();
        if (flat) flat.x1 = x1;
        else flat = { x0, x1, color: [...color] };
      }
      finish();
    }
    blocks.sort((a, b) => b.far - a.far);
    for (const { x0, x1, y0, y1, height, color: seen } of blocks) {
      const color = [...seen];
      const x = eye.at[0] > (x0 + x1) / 2 ? x1 : x0;
      const y = eye.at[1] > (y0 + y1) / 2 ? y1 : y0;
      this.#fill(context, eye, [[x, y0, 0], [x, y1, 0], [x, y1, height], [x, y0, height]], color, 0.75);
      this.#fill(context, eye, [[x0, y, 0], [x1, y, 0], [x1, y, height], [x0, y, height]], color, 0.6);
      this.#fill(context, eye, [[x0, y0, height], [x1, y0, height], [x1, y1, height], [x0, y1, height]], color, 1);
    }
  }

  #draw() {
    if (!this.#model) return;
    const [canvas, context, eye] = [this.#canvas, this.#context, this.#eye()];
    const poses = linkPoses(this.#model, this.#positions ?? {});
    if (!this.#background) {
      // What does not move is drawn once.
      this.#background = new OffscreenCanvas(canvas.width, canvas.height);
      const still = this.#background.getContext("2d");
      still.fillStyle = "#10171f";
      still.fillRect(0, 0, canvas.width, canvas.height);
      this.#solids(still, eye, poses, (link) => link.fixed);
      this.#blocks(still, eye);
    }
    context.drawImage(this.#background, 0, 0);
    for (let index = 1; index < this.#path.length; index++) {
      const { at, holds } = this.#path[index];
      context.beginPath();
      context.moveTo(...this.#project(eye, this.#path[index - 1].at).slice(0, 2));
      context.lineTo(...this.#project(eye, at).slice(0, 2));
      context.strokeStyle = holds ? "#5cd6c0" : "#ffffff88";
      context.lineWidth = holds ? 3 : 1.5;
      context.stroke();
    }
    context.lineWidth = 1;
    this.#solids(context, eye, poses, (link) => !link.fixed);
  }
}
