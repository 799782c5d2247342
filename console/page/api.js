// The console's API: docs/operator_console.openapi.yaml.

const PRESENCE_PERIOD_MS = 200;
const LONGEST_WAIT_MS = 5000;

/** An answer that something was not done: `reason` and `advice` are sentences. */
export class Refused extends Error {
  constructor(status, { reason, advice }) {
    super(`${reason} ${advice}`);
    this.status = status;
  }
}

/** The token comes in the URL's fragment, which no server sees, and is kept for this tab alone. */
function takeToken() {
  const given = new URLSearchParams(location.hash.slice(1)).get("token");
  if (given) {
    sessionStorage.setItem("token", given);
    history.replaceState(null, "", location.pathname);
  }
  return sessionStorage.getItem("token") ?? "";
}

export class Api {
  #token = takeToken();
  #session = sessionStorage.getItem("session");
  #socket = null;
  #wait_ms = 250;

  /** Number of this viewer. */
  viewer = Number(sessionStorage.getItem("viewer"));

  /** `onState` is given each state, `onLink` a word for each change of the link: "up", "lost", "join", "token". */
  constructor(onState, onLink) {
    this.onState = onState;
    this.onLink = onLink;
    setInterval(() => this.#showPresence(), PRESENCE_PERIOD_MS);
    document.addEventListener("visibilitychange", () => this.#showPresence());
  }

  /** Connects where this tab has joined already. */
  start() {
    if (!this.#token) {
      this.onLink("token");
    } else if (this.#session) {
      this.#connect();
    } else {
      this.onLink("join");
    }
  }

  async join(name) {
    const { viewer, session } = await this.post("sessions", { name });
    this.viewer = viewer;
    this.#session = session;
    sessionStorage.setItem("viewer", viewer);
    sessionStorage.setItem("session", session);
    sessionStorage.setItem("name", name);
    this.#connect();
  }

  async post(path, body) {
    const headers = { "Content-Type": "application/json" };
    const response = await this.#fetch(path, { method: "POST", headers, body: JSON.stringify(body ?? {}) });
    return response.status === 200 ? response.json() : undefined;
  }

  /** Nothing where there is nothing now. */
  async get(path) {
    const response = await this.#fetch(path, {});
    return response.status === 204 ? null : response.json();
  }

  async text(path) {
    return (await this.#fetch(path, {})).text();
  }

  /** A camera's image and its number. */
  async image(path) {
    const response = await this.#fetch(path, {});
    const header = (name) => Number(response.headers.get(name));
    const [height, width] = [header("x-rows"), header("x-cols")];
    const rgb = new Uint8Array(await response.arrayBuffer());
    const image = new ImageData(width, height);
    for (let pixel = 0; pixel < width * height; pixel++) {
      image.data.set(rgb.subarray(3 * pixel, 3 * pixel + 3), 4 * pixel);
      image.data[4 * pixel + 3] = 255;
    }
    return { number: header("x-number"), image };
  }

  /** The score maps of pick and place, each as colours without heights, and their number. */
  async scores() {
    const response = await this.#fetch("scores", {});
    if (response.status === 204) throw new Error("There are no scores of the present proposal.");
    const header = (name) => Number(response.headers.get(name));
    const [rows, width] = [header("x-rows"), header("x-cols")];
    const [rgb, cols] = [new Uint8Array(await response.arrayBuffer()), width / 2];
    const number = header("x-number");
    const half = (side) => {
      const colors = new Uint8Array(3 * rows * cols);
      for (let row = 0; row < rows; row++) {
        const start = 3 * (row * width + side * cols);
        colors.set(rgb.subarray(start, start + 3 * cols), 3 * row * cols);
      }
      return { key: `${number} ${side}`, rows, cols, rgb: colors, height_m: new Float32Array(rows * cols) };
    };
    return { number, pick_scores: half(0), place_scores: half(1) };
  }

  /** Colours and heights of a heightmap, and its number. */
  async heightmap(which) {
    const response = await this.#fetch(which.includes("/") ? which : `heightmaps/${which}`, {});
    const header = (name) => Number(response.headers.get(name));
    const [rows, cols] = [header("x-rows"), header("x-cols")];
    const bytes = await response.arrayBuffer();
    const cells = rows * cols;
    // Floats have to be aligned: copied.
    const height_m = new Float32Array(bytes.slice(3 * cells));
    return { number: header("x-number"), rows, cols, rgb: new Uint8Array(bytes, 0, 3 * cells), height_m };
  }

  async #fetch(path, options) {
    const headers = { ...options.headers, Authorization: `Bearer ${this.#token}`, "X-Session": this.#session ?? "" };
    let response;
    try {
      response = await fetch(`/api/v1/${path}`, { ...options, headers });
    } catch {
      throw new Refused(0, { reason: "The console does not answer.", advice: "Wait until the link is back, then look at the cell again." });
    }
    if (!response.ok) {
      const nothing = { reason: `The console answered ${response.status}.`, advice: "Reload the page." };
      throw new Refused(response.status, await response.json().catch(() => nothing));
    }
    return response;
  }

  #connect() {
    const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/api/v1/live`);
    this.#socket = socket;
    socket.onopen = () => socket.send(JSON.stringify({ type: "hello", token: this.#token, session: this.#session }));
    socket.onmessage = (event) => {
      this.#wait_ms = 250;
      this.onLink("up");
      this.onState(JSON.parse(event.data));
    };
    socket.onclose = (event) => {
      if (this.#socket !== socket) return;
      this.#socket = null;
      this.onLink("lost");
      setTimeout(() => this.#again(event.code === 1008), this.#wait_ms);
      this.#wait_ms = Math.min(2 * this.#wait_ms, LONGEST_WAIT_MS);
    };
  }

  /** After a refusal the session may be over, for instance because the console was started anew. */
  async #again(refused) {
    if (!refused) return this.#connect();
    try {
      await this.join(sessionStorage.getItem("name") ?? "");
    } catch (error) {
      if (error.status === 401) this.onLink("token");
      else if (error.status === 0) setTimeout(() => this.#again(true), this.#wait_ms);
      else this.onLink("join");
    }
  }

  #showPresence() {
    if (this.#socket?.readyState === WebSocket.OPEN) {
      this.#socket.send(JSON.stringify({ type: "present", visible: document.visibilityState === "visible" }));
    }
  }
}
