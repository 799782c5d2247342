// The operator's page: what the console says, as pictures and words, and the operator's decisions.

import { Api } from "./api.js";
import { Arm } from "./arm.js";
import { CameraViews } from "./cameras.js";
import { board, draw, drawAxes, drawObject, drawProposal, handTip, make, middleOfObject, pointed } from "./view.js";

const ROBOT_MODES = {
  "-1": "no controller", 0: "disconnected", 1: "confirm safety", 2: "booting", 3: "power off", 4: "power on", 5: "idle",
  6: "backdrive", 7: "running", 8: "updating firmware",
};
const SAFETY_MODES = {
  1: "normal", 2: "reduced", 3: "protective stop", 4: "recovery", 5: "safeguard stop", 6: "system emergency stop",
  7: "robot emergency stop", 8: "violation", 9: "fault", 10: "validate joint id", 11: "undefined", 12: "automatic mode safeguard stop",
  13: "three-position enabling stop",
};
const LEGENDS = {
  color: "Yellow ring: pick. Green cross: place; its hand shows the turn.",
  height: "Dark blue: the table. Yellow: the highest.",
  pick_scores: "Where the policy would pick: the brighter, the higher its score.",
  place_scores: "Where the policy would place: the brighter, the higher its score.",
  difference: "Orange: something is to come here. Blue: something is to go. Pink: the colour differs.",
};
const DECISIONS = ["approve", "reject", "advance", "retry", "stop"];

const $ = (id) => document.getElementById(id);
const boards = { now: board($("board-now"), "The table now, from above"), goal: board($("board-goal"), "The goal of this step, from above") };

let state = null;
let link = "lost";
/** Pictures by which they are: present, goal, goal-2, before-1. */
const pictures = new Map();
/** What is being loaded, by what it is. */
const loading = new Map();
/** What the operator was told about the last click. */
let answer = "";
let busy = false;
/** The operator's own pick and place while it is being made. */
let correction = null;
/** Phase of the lesson that the page shows. */
let lessonShown = "";
/** Number of the library's change that the page shows. */
let libraryShown = null;

const api = new Api((next) => { state = next; render(); }, (word) => {
  if (word === "up" && link !== "up") {
    libraryShown = null;
    loadSettings();
    loadCheckpoints();
  }
  link = word;
  renderLink();
});

/** Changes the page only where its text is another one: what has the focus or is being read stays. */
function setText(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

function isOperator() {
  return state !== null && state.operator === api.viewer;
}

/** Loads a picture unless it is there. */
function need(which, number, load = () => api.heightmap(which)) {
  const picture = pictures.get(which);
  if (picture?.number === number) return picture;
  if (!loading.has(which)) {
    // What a past step has led to is often what the table looks like now: it is not loaded twice.
    const isPresent = /^(before|after)-/.test(which) && state.heightmap?.number === number;
    const [source, present] = isPresent ? [loading.get("present"), pictures.get("present")] : [];
    const asked = present?.number === number ? Promise.resolve(present) : source ?? load();
    loading.set(which, asked);
    // What did not come is asked for again with the next state.
    asked.then((found) => { pictures.set(which, found); loading.delete(which); render(); }, () => loading.delete(which));
  }
  return null;
}

/** What brings the arm home, in words. */
const RECOVERIES = {
  home: { name: "The way home", go: "Go home this way", going: "The arm goes home.", shown: "This is the way home: it is played below." },
  put_down: {
    name: "Putting the part down",
    go: "Put it down this way",
    going: "The arm puts the part down and goes home.",
    shown: "The part is put down where it was picked, and the arm goes home: it is played below.",
  },
};

/** The first stream that has to be fresh and is not. */
function silent() {
  return state?.streams.find((stream) => stream.required && stream.stale)?.name;
}

/** Why a decision cannot be made here and now; nothing where it can. */
function obstacle(action) {
  if (link !== "up") return "The link to the console is lost: what you see is old.";
  if (correction && ["approve", "reject"].includes(action)) return "You are correcting: propose it, or keep the policy's.";
  if (!state) return "Nothing has come from the cell yet.";
  if (action === "stop") return state.lesson ? undefined : state.refused.stop?.reason;
  if (busy) return "The last click is on its way.";
  if (!isOperator()) {
    const operator = state.viewers.find((viewer) => viewer.operator);
    return operator ? `${operator.name} decides. You are watching.` : "You are watching. Take control to decide.";
  }
  if (action === "go-home") return state.motion?.proposal_id === state.home?.proposal_id ? undefined : "The motion is being planned.";
  if (state.home && !state.home.approved && action === "approve") return `${RECOVERIES[state.home.recovery].name} is shown: decide on it first.`;
  if (state.lesson && !["home", "put-down", "execute"].includes(action)) return "A lesson is being given. Save it or end it first.";
  if (action === "teach") return state.phase === "moving" ? "The arm is moving." : undefined;
  if (action === "correct") return ["proposed", "awaiting_proposal"].includes(state.phase) ? undefined : "Nothing can be proposed now.";
  if (action === "execute" && silent()) return `${silent()} is stale: what you see may not be what is there.`;
  if (action === "home" || action === "put-down") return state.phase === "moving" || state.lesson?.phase === "moving" ? "The arm is moving." : undefined;
  if (action === "continue") return state.phase === "stopped" ? undefined : "The run is not stopped.";
  const refused = state.refused[action];
  if (refused) return `${refused.reason} ${refused.advice}`;
  if (action === "approve" && pictures.get("present")?.number !== state.heightmap?.number) return "The newest picture is on its way.";
  return undefined;
}

async function act(action) {
  const why = obstacle(action);
  if (why) {
    answer = why;
    return renderButtons();
  }
  if (action === "correct") return correction ? endCorrection() : beginCorrection();
  busy = true;
  answer = "";
  // It is on its way before the page shows that it is.
  const asked = action === "home" ? api.post("home")
    : action === "put-down" ? api.post("put_down")
    : action === "go-home" ? api.post("decisions", { proposal_id: state.home.proposal_id, decision: "approve" })
    : action === "teach" ? api.post("lesson/begin")
    : action === "continue" ? api.post("step", { step: state.goal.step })
    : api.post("decisions", { proposal_id: state.proposal?.id ?? "0", decision: action });
  renderButtons();
  try {
    await asked;
  } catch (error) {
    answer = error.message;
  }
  busy = false;
  renderButtons();
}

const RADIANS = Math.PI / 180;
const form = $("correction");

function beginCorrection() {
  const { heightmap: map, proposal } = state;
  const middle = { x_m: map.origin_x_m + (map.cols * map.pixel_size_m) / 2, y_m: map.origin_y_m + (map.rows * map.pixel_size_m) / 2, yaw_rad: 0 };
  correction = structuredClone({ pick: proposal?.pick ?? middle, place: proposal?.place ?? middle });
  answer = "";
  showCorrection();
  form.elements.pick_x.focus();
}

function endCorrection() {
  correction = null;
  showCorrection();
  $("correct").focus();
}

/** Numbers and drawing follow the correction. */
function showCorrection() {
  const choosing = Boolean(correction) && (state.lesson?.phase ?? "choosing") === "choosing";
  form.hidden = !choosing;
  $("correct").setAttribute("aria-expanded", String(choosing));
  document.body.classList.toggle("correcting", choosing);
  if (correction) {
    const { pick, place } = correction;
    const turn = pick && place ? turnOf(correction) : 0;
    const numbers = { pick_x: pick?.x_m * 1000, pick_y: pick?.y_m * 1000, place_x: place?.x_m * 1000, place_y: place?.y_m * 1000, turn };
    for (const [name, value] of Object.entries(numbers)) {
      if (document.activeElement !== form.elements[name]) form.elements[name].value = Number.isFinite(value) ? Math.round(value) : "";
    }
  }
  render();
}

form.addEventListener("input", (event) => {
  if (!correction || event.target.type !== "number") return;
  const number = (name) => form.elements[name].valueAsNumber;
  const next = { pick_x: number("pick_x"), pick_y: number("pick_y"), place_x: number("place_x"), place_y: number("place_y"), turn: number("turn") };
  if (!Object.values(next).every(Number.isFinite)) return;
  const pick = (correction.pick ??= { yaw_rad: 0 });
  const place = (correction.place ??= {});
  Object.assign(pick, { x_m: next.pick_x / 1000, y_m: next.pick_y / 1000 });
  Object.assign(place, { x_m: next.place_x / 1000, y_m: next.place_y / 1000, yaw_rad: pick.yaw_rad + next.turn * RADIANS });
  render();
});
form.addEventListener("submit", async (event) => {
  event.preventDefault();
  await ask(async () => {
    if (state.lesson) return api.post("lesson/show", { ...correction, settings: chosenSettings() });
    await api.post("proposals", correction);
    endCorrection();
    $("approve").focus();
  });
});
$("cancel-correction").addEventListener("click", endCorrection);

const SETTINGS = [
  ["clearance_m", "Height above the table", 0.005, 1000, "mm"], ["lift_m", "Height while it carries", 0.005, 1000, "mm"],
  ["travel_m_s", "Speed without an object", 0.01, 1000, "mm/s"], ["carry_m_s", "Speed while it carries", 0.01, 1000, "mm/s"],
  ["descend_m_s", "Speed of the descent", 0.005, 1000, "mm/s"], ["acceleration_m_s2", "Acceleration", 0.1, 1, "m/s²"],
];
let offered = null;

/** Presets and ranges of the motion of a lesson's step, as sliders. */
async function loadSettings() {
  offered = await api.get("lesson/settings").catch(() => null);
  if (!offered || $("sliders").children.length) return;
  for (const [name, words, step, factor, unit] of SETTINGS) {
    const [min, max] = offered.ranges[name];
    const slider = make("input", { type: "range", name, min, max, step });
    const value = make("output", {});
    const show = () => {
      value.textContent = `${(factor * slider.valueAsNumber).toFixed(factor > 1 ? 0 : 1)} ${unit}`;
      slider.setAttribute("aria-valuetext", value.textContent);
    };
    slider.addEventListener("input", show);
    slider.addEventListener("preset", show);
    $("sliders").append(make("label", {}, `${words} `, slider, value));
  }
  takePreset();
}

function takePreset() {
  for (const [name, value] of Object.entries(offered?.presets[form.elements.preset.value] ?? {})) {
    form.elements[name].value = value;
    form.elements[name].dispatchEvent(new Event("preset"));
  }
}
form.elements.preset.addEventListener("change", takePreset);

function chosenSettings() {
  return Object.fromEntries(SETTINGS.map(([name]) => [name, form.elements[name].valueAsNumber]));
}

/** Asks for something, and shows why it was not done. */
async function ask(what) {
  answer = "";
  try {
    await what();
  } catch (error) {
    answer = error.message;
  }
  renderButtons();
}

// A lesson: pick and place are chosen as in a correction, the planned motion is shown, and carried out when the person says so.
$("execute").addEventListener("click", () => {
  const why = obstacle("execute");
  if (!why) return void ask(() => api.post("lesson/execute"));
  answer = why;
  renderButtons();
});
$("change").addEventListener("click", () => ask(() => api.post("lesson/change")));
$("leave-home").addEventListener("click", () => ask(() => api.post("decisions", { proposal_id: state.home.proposal_id, decision: "reject" })));
$("reached").addEventListener("click", () => ask(() => api.post("lesson/judge", { reached: true })));
$("missed").addEventListener("click", () => ask(() => api.post("lesson/judge", { reached: false })));
$("undo").addEventListener("click", () => ask(() => api.post("lesson/undo")));
$("end-lesson").addEventListener("click", () => {
  if (state.lesson?.unsaved && !confirm("The lesson has steps that are not saved. End it all the same?")) return;
  ask(() => api.post("lesson/end"));
});
$("save-lesson").addEventListener("submit", (event) => {
  event.preventDefault();
  const { name } = event.target.elements;
  ask(async () => {
    await api.post("lesson/save", { name: name.value });
    answer = `Saved as ${name.value}.`;
  });
});

const LESSON_WORDS = {
  choosing: "Click what to pick, then where to place it.",
  planning: "The executor plans the motion.",
  previewing: "This is how the arm would move. Have it carried out, or change it.",
  moving: "The arm moves. Watch it; stop if anything is wrong.",
  looking: "The cameras look at the result.",
  judging: "Is this as it should be?",
};

/** What has the focus next in a lesson that is given by keyboard. */
const LESSON_FOCUS = { previewing: "execute", judging: "reached" };

function renderLesson() {
  const { lesson } = state;
  const focused = $("lesson").contains(document.activeElement) || form.contains(document.activeElement);
  $("lesson").hidden = !lesson;
  document.body.classList.toggle("teaching", Boolean(lesson));
  form.elements.preset.parentElement.hidden = $("settings").hidden = !lesson;
  $("cancel-correction").hidden = Boolean(lesson);
  setText($("send-correction"), lesson ? "Show the motion" : "Propose this");
  setText($("correction-help"), lesson ? "Click what to pick, then where to place it, and drag the hand to turn it; or type." : "Drag pick, place and the hand of the turn on the picture, or type.");
  if (!lesson) {
    if (lessonShown) {
      lessonShown = "";
      correction = null;
      showCorrection();
    }
    return;
  }
  const choosing = lesson.phase === "choosing";
  const judging = lesson.phase === "judging";
  const outcome = judging ? ` The arm ${lesson.outcome}.` : "";
  const undo = lesson.undoes ? " It takes the last step back." : "";
  setText($("lesson-state"), `Lesson, ${lesson.step_count} ${lesson.step_count === 1 ? "step" : "steps"} so far. ${LESSON_WORDS[lesson.phase]}${outcome}${undo}`);
  const previewing = lesson.phase === "previewing";
  const able = { execute: previewing, change: previewing || lesson.phase === "planning", reached: judging, missed: judging, undo: choosing && lesson.step_count > 0 };
  for (const [id, may] of Object.entries(able)) $(id).hidden = !may;
  $("save-lesson").hidden = !choosing || lesson.step_count === 0;
  $("end-lesson").hidden = lesson.phase === "moving";
  if (lessonShown !== lesson.phase) {
    const over = ["", "judging"].includes(lessonShown);
    // What was not carried out is changed; the next step is chosen anew: nothing is picked where nothing was clicked.
    if (choosing && (over || !correction || !isOperator())) {
      correction = state.heightmap && isOperator() ? { pick: null, place: null } : null;
    }
    lessonShown = lesson.phase;
    showCorrection();
    if (focused) (choosing && correction ? form.elements.pick_x : $(LESSON_FOCUS[lesson.phase] ?? "lesson-state")).focus();
  }
}

/** How runs of a task went. */
function success({ runs }) {
  const words = runs.map(({ checkpoint, completed, count }) => `${completed} of ${count} ${count === 1 ? "run" : "runs"} completed with ${checkpoint}`);
  return words.join(", ") || "not repeated yet";
}

/** Names of corrections by the words for all of one problem. */
let corrections = new Map();

async function loadLibrary() {
  const listed = await api.get("demonstrations").catch(() => null);
  if (!listed) return;
  const list = listed.tasks;
  setText($("library-note"), list.length ? "" : "No task has been saved yet.");
  const items = list.map((entry) => {
    const saved = new Date(1000 * entry.saved_at_s).toLocaleString();
    const repeat = make("button", { type: "button", textContent: `Repeat ${entry.name}` });
    repeat.addEventListener("click", () => {
      if (isOperator()) ask(() => api.post("demonstrations/repeat", { name: entry.name }));
      else setText($("library-note"), "You are watching. Take control to have a task repeated.");
    });
    const pictures = make("div", { className: "pair" });
    for (const [step, label] of [[0, "start"], [entry.step_count, "end"]]) {
      const container = make("div", { className: "board" });
      const { canvas } = board(container, `${entry.name}, ${label}`);
      api.heightmap(`demonstrations/${entry.name}/${step}`).then((picture) => draw(canvas, picture, "color")).catch(() => {});
      pictures.append(make("figure", {}, make("figcaption", { className: "small", textContent: label === "start" ? "Start" : "End" }), container));
    }
    const words = `${entry.name}: ${entry.step_count} ${entry.step_count === 1 ? "step" : "steps"}, ${saved}`;
    return make("li", {}, make("p", { textContent: words }), make("p", { className: "small", textContent: success(entry) }), pictures, repeat);
  });
  const focused = $("library").contains(document.activeElement) && document.activeElement.textContent;
  $("library").replaceChildren(...items);
  [...$("library").querySelectorAll("button")].find((button) => button.textContent === focused)?.focus();
  corrections = new Map();
  for (const { name } of listed.corrections) {
    // PROBLEM-STEP-ID, where the problem's name may have a - too.
    const words = `corrections of ${name.split("-").slice(0, -2).join("-")}`;
    corrections.set(words, [...(corrections.get(words) ?? []), name]);
  }
  // What is chosen stays so when the list is read again.
  const chosen = new Map([...document.querySelectorAll("#train-tasks select")].map((select) => [select.name, select.value]));
  const choices = [...list.map(({ name }) => name), ...corrections.keys()].map((name) => {
    const select = make("select", { name });
    for (const [value, words] of [["", "leave out"], ["learn", "learn from"], ["held_out", "hold out"]]) select.append(make("option", { value, textContent: words }));
    select.value = chosen.get(name) ?? "";
    const count = corrections.get(name)?.length;
    const words = count === 1 ? name.replace(/^corrections/, "1 correction") : count ? `${count} ${name}` : name;
    return make("label", {}, `${words} `, select);
  });
  $("train-tasks").replaceChildren($("train-tasks").firstElementChild, ...choices);
  $("train").hidden = choices.length < 2;
}

async function loadCheckpoints() {
  const list = await api.get("checkpoints").catch(() => []);
  const chosen = $("policy").value || policyKnown;
  $("policy").replaceChildren(...list.map(({ name }) => make("option", { value: name, textContent: name })));
  if (list.some(({ name }) => name === chosen)) $("policy").value = chosen;
  $("policy-label").hidden = $("use-policy").hidden = list.length === 0;
}

/** Asks the policy for another checkpoint. */
function changePolicy(path, body) {
  if (!isOperator()) setText($("policy-note"), "You are watching. Take control to change the policy.");
  else ask(() => api.post(path, body));
}
$("use-policy").addEventListener("click", () => changePolicy("checkpoints/use", { name: $("policy").value }));
$("policy-back").addEventListener("click", () => changePolicy("checkpoints/back"));

$("train").addEventListener("submit", (event) => {
  event.preventDefault();
  if (!isOperator()) return setText($("training-state"), "You are watching. Take control to train.");
  const { name, steps } = event.target.elements;
  const tasks = (use) => [...document.querySelectorAll("#train-tasks select")].filter((select) => select.value === use).flatMap((select) => corrections.get(select.name) ?? [select.name]);
  ask(() => api.post("training/start", { name: name.value, steps: steps.valueAsNumber, learn: tasks("learn"), held_out: tasks("held_out") }));
});
$("cancel-training").addEventListener("click", () => ask(() => api.post("training/cancel")));

let trainingShown = "";

/** A distance from held-out steps, in words. */
const distanceWords = ({ pick_m, place_m, turn_rad }) => [`${(1000 * pick_m).toFixed(1)} mm`, `${(1000 * place_m).toFixed(1)} mm`, `${(turn_rad / RADIANS).toFixed(1)}°`];

/** Held-out steps side by side: as shown, by the new policy, and by the policy of now. */
async function loadExamples(name) {
  const examples = await api.get("training/comparison").catch(() => []);
  const items = examples.map(({ demonstration, step, shown, new: proposed, now }) => {
    const boardOf = ([words, action]) => {
      const container = make("div", { className: "board" });
      const { canvas, svg } = board(container, `${demonstration}, step ${step}, ${words}`);
      api.heightmap(`demonstrations/${demonstration}/${step - 1}`).then((picture) => {
        draw(canvas, picture, "color");
        const map = state.heightmap;
        if (map?.rows === picture.rows && map.cols === picture.cols) drawProposal(svg, map, picture, action);
      }).catch(() => {});
      return make("figure", {}, make("figcaption", { textContent: words }), container);
    };
    const boards = [["as shown", shown], [`by ${name}`, proposed], ["by the policy of now", now]].map(boardOf);
    return make("li", {}, make("p", { textContent: `${demonstration}, step ${step}` }), make("div", { className: "triple" }, ...boards));
  });
  $("examples").replaceChildren(...items);
}

function renderTraining() {
  const { training } = state;
  const atWork = training?.phase === "training" || training?.phase === "comparing";
  $("cancel-training").hidden = $("training-progress").hidden = !atWork;
  $("comparison").hidden = $("examples").hidden = !training?.comparison;
  if (!training) return;
  $("training-progress").value = training.step / training.steps;
  const words = {
    training: `${training.name} is being trained: step ${training.step} of ${training.steps}. ${training.losses}${training.left ? `, ${training.left} left` : ""}`,
    comparing: `${training.name} is compared with the policy of now on the held-out steps.`,
    done: `${training.name} is trained. Choose it above to use it.`,
    cancelled: `The training of ${training.name} was cancelled.`,
    failed: `The training of ${training.name} failed: ${training.reason}`,
  };
  setText($("training-state"), words[training.phase]);
  renderList($("validation"), training.validation, (snapshot) => [training.name, snapshot], (snapshot) => {
    const [pick, place, turn] = distanceWords(snapshot);
    return make("li", { textContent: `Step ${snapshot.step}: pick ${pick}, place ${place}, turn ${turn} from the held-out steps.` });
  });
  const { comparison } = training;
  if (comparison) {
    const row = (name, distance) => make("tr", {}, make("th", { scope: "row", textContent: name }),
      ...distanceWords(distance).map((textContent) => make("td", { textContent })));
    setText($("comparison").caption, `Median distance from ${comparison.steps} held-out ${comparison.steps === 1 ? "step" : "steps"}`);
    $("comparison").tBodies[0].replaceChildren(row(training.name, comparison.new), row("policy of now", comparison.now));
  }
  const phase = `${training.name} ${training.phase}`;
  if (phase !== trainingShown && training.phase === "done") {
    loadCheckpoints();
    loadExamples(training.name);
  }
  trainingShown = phase;
}

let policyKnown = "";

function renderPolicy() {
  const name = (path) => path.split("/").at(-1).replace(/\.safetensors$/, "");
  const { policy, proposal } = state;
  $("policy-back").hidden = !policy;
  if (policy) setText($("policy-back"), `Go back to ${name(policy.previous)}`);
  // A person's proposal has no checkpoint.
  const now = policy ? name(policy.checkpoint) : proposal?.checkpoint || policyKnown;
  if (now !== policyKnown) {
    policyKnown = now;
    $("policy").value = now;
  }
  if (isOperator() || !$("policy-note").textContent) setText($("policy-note"), now ? `The policy uses ${now}.` : "");
}

/** Drags what is nearest to the pointer: pick or place. */
boards.now.svg.addEventListener("pointerdown", (event) => {
  if (!correction || form.hidden) return;
  // A field that has the focus is not written to while somebody types.
  if (form.contains(document.activeElement)) document.activeElement.blur();
  const { svg } = boards.now;
  const [x_m, y_m] = pointed(state.heightmap, svg, event);
  const distance = (pose) => Math.hypot(pose.x_m - x_m, pose.y_m - y_m);
  // In a lesson the first click is the pick, the second the place.
  for (const which of ["pick", "place"]) {
    if (correction[which]) continue;
    correction[which] = { x_m, y_m, yaw_rad: 0 };
    if (which === "pick") {
      const picture = pictures.get("present");
      if (picture) [correction.pick.x_m, correction.pick.y_m] = middleOfObject(state.heightmap, picture, x_m, y_m);
      return showCorrection();
    }
    break;
  }
  const { pick, place } = correction;
  const [tipX_m, tipY_m] = handTip(state.heightmap, correction);
  const tipDistance = Math.hypot(tipX_m - x_m, tipY_m - y_m);
  const dragged = tipDistance < Math.min(distance(pick), distance(place)) ? "turn" : distance(pick) < distance(place) ? "pick" : "place";
  const drag = (moved) => {
    // It may have been taken away under the pointer.
    if (!correction) return;
    const [toX_m, toY_m] = pointed(state.heightmap, svg, moved);
    if (dragged === "turn") place.yaw_rad = pick.yaw_rad + Math.atan2(toY_m - place.y_m, toX_m - place.x_m);
    else Object.assign(correction[dragged], { x_m: toX_m, y_m: toY_m });
    showCorrection();
  };
  drag(event);
  svg.setPointerCapture(event.pointerId);
  svg.addEventListener("pointermove", drag);
  svg.addEventListener("pointerup", () => svg.removeEventListener("pointermove", drag), { once: true });
});

/** In a lesson the object under the cursor is outlined before it is picked. */
boards.now.svg.addEventListener("pointermove", (event) => {
  const picture = pictures.get("present");
  if (form.hidden || !correction || correction.pick || !picture) return;
  const { svg } = boards.now;
  drawObject(svg, state.heightmap, picture, ...pointed(state.heightmap, svg, event));
  svg.dataset.drawn = "object";
});
boards.now.svg.addEventListener("pointerleave", () => { if (boards.now.svg.dataset.drawn === "object") render(); });

function changeOperator(change) {
  return ask(() => api.post("operator", change));
}

function renderLink() {
  const words = {
    up: "Connected", lost: "Link lost: connecting again…", join: "Not joined",
    token: "No valid token: open the address that the console printed when it was started",
  };
  setText($("link"), words[link]);
  document.body.classList.toggle("lost", link !== "up");
  if (link === "join" && !$("join").open) $("join").showModal();
  renderButtons();
}

function renderRole() {
  const operator = state.viewers.find((viewer) => viewer.operator);
  setText($("role"), isOperator() ? "You decide" : operator ? `You watch. ${operator.name} decides` : "You watch. Nobody decides");
  const control = $("control");
  const wanted = isOperator() ? "release" : operator ? `take ${operator.id}` : "take";
  if (control.dataset.shown === wanted) return;
  control.dataset.shown = wanted;
  const focused = control.contains(document.activeElement);
  let button;
  if (isOperator()) {
    button = make("button", { type: "button", textContent: "Give up control", onclick: () => changeOperator({ action: "hand_over", to: null }) });
  } else {
    const text = operator ? `Take control from ${operator.name}` : "Take control";
    button = make("button", { type: "button", textContent: text, onclick: () => changeOperator({ action: "take", from: operator?.id ?? null }) });
  }
  control.replaceChildren(button);
  if (focused) button.focus();
}

function renderButtons() {
  for (const action of [...DECISIONS, "correct", "home", "put-down", "go-home", "continue", "teach", "execute"]) {
    $(action).setAttribute("aria-disabled", String(Boolean(obstacle(action))));
  }
  const stopped = state?.phase === "stopped";
  const judging = state?.phase === "awaiting_confirmation" || state?.phase === "fault";
  // What cannot be meant now is not offered.
  const lesson = Boolean(state?.lesson);
  const running = !judging && !stopped && !lesson;
  const holds = Boolean(state?.robot.vacuum) && state.phase !== "moving" && state.lesson?.phase !== "moving" && !state.home?.approved;
  const shown = { "put-down": holds, approve: running, reject: running, correct: running, advance: judging && !lesson, retry: judging && !lesson, continue: stopped && !lesson };
  for (const [action, show] of Object.entries(shown)) {
    const button = $(action);
    if (!show && document.activeElement === button) $("headline").focus();
    button.hidden = !show;
  }
  const { home } = state ?? {};
  if ($("way-home").contains(document.activeElement) && (!home || home.approved)) $("headline").focus();
  $("way-home").hidden = !home;
  $("go-home").hidden = $("leave-home").hidden = !home || home.approved;
  if (home) {
    const { go, going, shown } = RECOVERIES[home.recovery];
    setText($("go-home-what"), go);
    setText($("way-home-state"), home.approved ? `${going} Watch it; stop if anything is wrong.` : `${shown} Nothing moves before you approve it.`);
  }
  const main = lesson ? "execute" : judging ? "advance" : stopped ? "continue" : "approve";
  setText($("why"), answer || (lesson && isOperator() && state.lesson.phase !== "previewing" ? "" : obstacle(main)) || "");
  const stale = link !== "up" || Boolean(silent()) || (state?.phase === "proposed" && state.stale);
  document.body.classList.toggle("stale", stale);
}

/** How far the object turns, from -180 to 180 degrees. */
function turnOf({ pick, place }) {
  const turn = (place.yaw_rad - pick.yaw_rad) / RADIANS;
  return ((((turn + 180) % 360) + 360) % 360) - 180;
}

function renderPictures() {
  const mode = document.querySelector("input[name=mode]:checked").value;
  setText($("legend"), LEGENDS[mode]);
  const map = state.heightmap;
  const present = map && (need("present", map.number) ?? pictures.get("present"));
  const goalMap = state.goal?.heightmap;
  const goal = goalMap && (need("goal", goalMap.number) ?? pictures.get("goal"));
  const scored = mode.endsWith("_scores");
  $("boards").classList.toggle("scored", scored);
  const scores = scored && state.scores ? need("scores", state.scores, () => api.scores()) : null;
  for (const [{ axes }, at] of [[boards.now, map], [boards.goal, goalMap]]) {
    const lies = at && [at.rows, at.cols, at.pixel_size_m, at.origin_x_m, at.origin_y_m].join(" ");
    if (!at || axes.dataset.drawn === lies) continue;
    axes.dataset.drawn = lies;
    drawAxes(axes, at);
  }
  if (scored && !state.scores) setText($("legend"), "There are no scores of the present proposal.");
  const drawn = `${mode} ${present?.number} ${mode === "difference" ? goal?.number : ""} ${scores?.number}`;
  if ($("boards").dataset.drawn !== drawn) {
    $("boards").dataset.drawn = drawn;
    const shown = scores?.[mode] ?? present;
    const share = shown ? draw(boards.now.canvas, shown, scored ? "color" : mode, goal) : 0;
    setText($("now-note"), mode === "difference" && present && goal ? `(${(100 * share).toFixed(1)} % of it differs from the goal)` : "");
  }
  const goalDrawn = `${mode} ${goal?.number}`;
  if (goal && boards.goal.canvas.dataset.drawn !== goalDrawn) {
    boards.goal.canvas.dataset.drawn = goalDrawn;
    draw(boards.goal.canvas, goal, mode === "difference" || scored ? "color" : mode);
  }
  setText($("now-age"), map ? `, ${Math.round(map.age_s)} s old` : "");
  setText($("goal-note"), state.goal ? `(step ${state.goal.step} of ${state.goal.step_count}, ${state.goal.module})` : "");
  if (correction && !state.lesson && !["proposed", "awaiting_proposal"].includes(state.phase)) return endCorrection();
  const shownStep = ["planning", "previewing", "moving"].includes(state.lesson?.phase) ? state.lesson : null;
  const choosing = correction && !form.hidden;
  const proposal = shownStep ?? (choosing ? correction : !state.lesson && ["proposed", "moving"].includes(state.phase) ? state.proposal : null);
  for (const [name, at] of [["now", map], ["goal", goalMap]]) {
    const { svg } = boards[name];
    const overlay = JSON.stringify([proposal?.pick, proposal?.place, choosing, present?.number]);
    if (!at || svg.dataset.drawn === overlay) continue;
    svg.dataset.drawn = overlay;
    drawProposal(svg, at, present, proposal, name === "now" && Boolean(choosing));
  }
  cameras.show(map, present, proposal, scores?.[mode]);
  const lies = ({ x_m, y_m }) => `x ${(1000 * x_m).toFixed(0)} mm, y ${(1000 * y_m).toFixed(0)} mm`;
  setText($("proposal"), choosing
    ? correction.pick && correction.place
      ? `Your pick at ${lies(proposal.pick)}. Your place at ${lies(proposal.place)}, turned by ${Math.round(turnOf(proposal))}°.`
      : correction.pick ? "Now click where to place it." : "Click what to pick."
    : shownStep ? `Pick at ${lies(proposal.pick)}. Place at ${lies(proposal.place)}, turned by ${Math.round(turnOf(proposal))}°.`
    : proposal
    ? `Pick at ${lies(proposal.pick)}. Place at ${lies(proposal.place)}, turned by ${Math.round(turnOf(proposal))}°.${whose(proposal)}`
    : "");
}

let motion = null;
let motionFor = "";
let robotAsked = false;

const arm = new Arm($("arm"), (time_s, goesOn) => {
  $("time").value = time_s;
  $("time").setAttribute("aria-valuetext", `${time_s.toFixed(1)} s`);
  setText($("play").firstChild, goesOn ? "Pause " : "Play the planned motion ");
});
$("time").addEventListener("input", () => {
  arm.stop();
  arm.show($("time").valueAsNumber);
});
$("play").addEventListener("click", playMotion);

function playMotion() {
  if (!arm.playing) return arm.play();
  arm.stop();
  arm.show($("time").valueAsNumber);
}

/** The motion of the proposal that waits, played once of itself unless the person wants less motion; else the robot as it is. */
function renderMotion() {
  if (state.robot_description && !robotAsked) {
    robotAsked = true;
    api.text("robot_description").then((urdf) => { arm.load(urdf); motionFor = ""; render(); }).catch(() => { robotAsked = false; });
  }
  const wanted = arm.ready && state.motion ? state.motion.proposal_id : "";
  if (wanted !== motionFor) {
    motionFor = wanted;
    motion = null;
    arm.setMotion(null);
    if (wanted) {
      api.get("motion").then((loaded) => {
        if (motionFor !== wanted) return;
        if (loaded?.proposal_id !== wanted) return void (motionFor = "");
        motion = loaded;
        arm.setMotion(loaded);
        if (loaded.times_s.length && !matchMedia("(prefers-reduced-motion: reduce)").matches) arm.play();
        render();
      }).catch(() => { motionFor = ""; });
    }
  }
  const playable = Boolean(motion?.times_s.length);
  $("play").hidden = $("time-label").hidden = !playable;
  if (playable) $("time").max = motion.times_s.at(-1);
  setText($("motion-note"), playable ? `The planned motion takes ${motion.times_s.at(-1).toFixed(1)} s. Green: with suction.`
    : motion?.reason ? `The motion cannot be planned: ${motion.reason}`
    : arm.ready ? "The robot as it is now." : "The robot's description has not arrived (topic robot_description).");
  const [map, present] = [state.heightmap, pictures.get("present")];
  const table = `${map?.number} ${present?.number}`;
  if (present && $("arm").dataset.table !== table) {
    $("arm").dataset.table = table;
    // It is much to draw: the picture from above is painted first.
    afterPaint(() => arm.setTable(map, present));
  }
  if (state.joints) arm.setPositions(state.joints);
}

const cameras = new CameraViews(api, $("cameras"), $("camera-list"));

/** Who made a proposal, and how sure of it; a person's corrections have no scores. */
function whose({ author, checkpoint, pick_score, place_score, success_probability, verdict }) {
  const percent = (share) => `${Math.round(100 * share)} %`;
  if (!checkpoint && author) return ` Made by ${author}.`;
  const by = author ? ` Made by ${author}${checkpoint ? ` with ${checkpoint}` : ""}.` : "";
  const success = success_probability == null ? "" : ` It expects the step to succeed with ${percent(success_probability)}.`;
  const doubt = verdict ? ` Look closely: ${verdict}.` : "";
  return `${by} Its scores: pick ${percent(pick_score)}, place ${percent(place_score)}.${success}${doubt}`;
}

/** A small picture in a list, with its caption. */
function thumbnail(which, number, label, caption) {
  const container = make("div", { className: "board" });
  const picture = number == null ? null : need(which, number);
  if (picture) draw(board(container, label).canvas, picture, "color");
  else container.append(make("span", { className: "unknown", textContent: "not seen yet" }));
  return make("figure", {}, make("figcaption", { className: "small", textContent: caption }), container);
}

/** Makes a list anew where it shows something else than before. */
function renderList(list, items, key, item) {
  const shown = JSON.stringify(items.map(key));
  if (list.dataset.shown === shown) return;
  list.dataset.shown = shown;
  list.replaceChildren(...items.map(item));
}

function renderStrip() {
  const goal = state.goal;
  const steps = goal ? Array.from({ length: goal.step_count }, (_, index) => index + 1) : [];
  const number = (step) => goal.strip[step];
  const ready = (step) => number(step) != null && pictures.get(`goal-${step}`)?.number === number(step);
  const now = (step) => step === goal.step && !goal.complete;
  renderList($("strip"), steps, (step) => [number(step), ready(step), now(step)], (step) => {
    const item = make("li", {}, thumbnail(`goal-${step}`, number(step), `Goal of step ${step}`, `Step ${step}${now(step) ? " (now)" : ""}`));
    if (now(step)) item.setAttribute("aria-current", "step");
    return item;
  });
}

function renderSteps() {
  const ready = (which) => pictures.get(which)?.number;
  const steps = state.steps.toReversed();
  renderList($("steps"), steps, (step) => [step.number, step.decision, step.after, ready(`before-${step.number}`), ready(`after-${step.number}`)], (step) => {
    const decided = { advance: "succeeded", retry: "failed" }[step.decision];
    const who = decided ? `: ${step.decided_by} said it ${decided}` : "";
    const text = `Step ${step.proposal.step}, attempt ${step.proposal.attempt + 1}: ${step.outcome}, ${step.duration_s.toFixed(1)} s${who}`;
    return make("li", {}, make("p", { textContent: text }), make("div", { className: "pair" },
      thumbnail(`before-${step.number}`, step.before, `Before step ${step.proposal.step}`, "Before"),
      thumbnail(`after-${step.number}`, step.after, `After step ${step.proposal.step}`, "After")));
  });
}

function renderPeople() {
  renderList($("people"), state.viewers, (viewer) => [viewer, isOperator()], (viewer) => {
    const me = viewer.id === api.viewer;
    const role = viewer.operator ? "decides" : "watches";
    const text = `${viewer.name}${me ? " (you)" : ""} ${role}${viewer.present ? "" : ", page not in sight"}`;
    const item = make("li", {}, make("span", { textContent: text }));
    if (isOperator() && !me) {
      item.append(make("button", { type: "button", textContent: `Hand over to ${viewer.name}`, onclick: () => changeOperator({ action: "hand_over", to: viewer.id }) }));
    }
    return item;
  });
}

function renderRobot() {
  const { robot } = state;
  const on = (value) => (value == null ? "unknown" : value ? "on" : "off");
  const rows = [
    ["Robot mode", ROBOT_MODES[robot.robot_mode] ?? "unknown"],
    ["Safety", SAFETY_MODES[robot.safety_mode] ?? "unknown"],
    ["Program", robot.program_running == null ? "unknown" : robot.program_running ? "running" : "not running"],
    ["Speed", robot.speed_scaling == null ? "unknown" : `${Math.round(100 * robot.speed_scaling)} % of the planned`],
    ["Suction", on(robot.suction)],
    ["Gripper", robot.vacuum == null ? "unknown" : robot.vacuum ? "holds something" : "empty"],
  ];
  for (const [node, said] of Object.entries(state.nodes)) {
    if (said.level > 0) rows.push([node.slice(1), said.message]);
  }
  renderList($("robot"), rows.flat(), (text) => text, (text, index) => make(index % 2 ? "dd" : "dt", { textContent: text }));
  renderList($("streams"), state.streams, (stream) => [stream.name, stream.age_s?.toFixed(1), stream.stale], (stream) => {
    const age = stream.age_s == null ? "never came" : `${stream.age_s.toFixed(1)} s`;
    const row = make("tr", { className: stream.stale ? "stale" : "" }, make("th", { scope: "row", textContent: stream.name }), make("td", { textContent: stream.stale ? `${age}, stale` : age }));
    return row;
  });
}

function renderMessages() {
  $("no-messages").hidden = state.notices.length > 0;
  renderList($("messages"), state.notices.toReversed(), (notice) => notice.number, (notice) => {
    const kind = { refusal: "Refused. ", fault: "Fault. ", note: "" }[notice.kind];
    return make("li", { className: notice.kind }, `${kind}${notice.reason} ${notice.advice}`);
  });
}

let restAsked = false;

/** Calls back once the browser has painted what is drawn by now and has nothing better to do, at the latest after 200 ms. */
function afterPaint(callback) {
  const next = window.requestIdleCallback ? () => requestIdleCallback(callback, { timeout: 200 }) : () => setTimeout(callback);
  requestAnimationFrame(next);
}

/** What a decision needs is shown at once; the rest after the browser has painted it. */
function render() {
  if (!state) return;
  renderDecision();
  if (restAsked) return;
  restAsked = true;
  afterPaint(() => {
    restAsked = false;
    renderRest();
  });
}

function renderDecision() {
  setText($("headline"), state.lesson ? "Teaching a new task" : state.headline);
  setText($("advice"), state.lesson ? "Show one pick and place after the other. The robot repeats them later, from where the objects lie then." : state.advice);
  renderRole();
  renderLesson();
  renderPictures();
  renderButtons();
}

function renderRest() {
  if (state.library !== libraryShown) {
    libraryShown = state.library;
    loadLibrary();
  }
  renderMotion();
  renderStrip();
  renderMessages();
  renderPolicy();
  renderTraining();
  renderPeople();
  renderRobot();
  renderSteps();
}

for (const action of [...DECISIONS, "correct", "home", "put-down", "go-home", "continue", "teach"]) $(action).addEventListener("click", () => act(action));
for (const radio of document.querySelectorAll("input[name=mode]")) radio.addEventListener("change", render);

const KEYS = new Map([...document.querySelectorAll("[aria-keyshortcuts]")].map((button) => [button.getAttribute("aria-keyshortcuts"), button.id]));
document.addEventListener("keydown", (event) => {
  const typing = event.target.matches?.("input:not([type=radio], [type=checkbox], [type=range]), select, textarea, dialog *");
  if (typing || event.repeat || event.ctrlKey || event.altKey || event.metaKey || !$("keys").checked) return;
  const action = KEYS.get(event.key.toLowerCase());
  if (action === "play" && !$("play").hidden) return playMotion();
  if (action && !$(action).hidden) {
    event.preventDefault();
    act(action);
  }
});

$("name").value = sessionStorage.getItem("name") ?? "";
$("join").addEventListener("cancel", (event) => event.preventDefault());
$("join-form").addEventListener("submit", async (event) => {
  event.preventDefault();
  try {
    await api.join($("name").value);
    $("join").close();
    $("join-error").textContent = "";
    $("headline").focus();
  } catch (error) {
    $("join-error").textContent = error.message;
  }
});
$("headline").tabIndex = -1;

api.start();
