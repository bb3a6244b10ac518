// The page: what the server tells, what the person does, and one picture of both each frame.

import { AttemptList } from "misstep/attempts.js";
import { Chart } from "misstep/chart.js";
import { Density } from "misstep/density.js";
import { fillSaveMenu, startHelp } from "misstep/dialogs.js";
import { byId, h, inShownUnit, nameOf, setText, show, shownUnit, signed } from "misstep/dom.js";
import { Input } from "misstep/input.js";
import { LearningPanel } from "misstep/learning.js";
import { getJson, Link, upload } from "misstep/link.js";
import { Model } from "misstep/model.js";
import { Plane } from "misstep/plane.js";
import { Player } from "misstep/player.js";
import { Stage } from "misstep/stage.js";
import { onTheme, startTheme } from "misstep/theme.js";

const SPEEDS = [0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.7, 1, 1.5];
const MEASURED = 600; // latencies and frames that the figures below the page are about
const replay = JSON.parse(byId("replay-data").textContent || "null");

const hasFingers = matchMedia("(pointer: coarse)").matches || (navigator.maxTouchPoints > 0 && innerWidth < 1100);

const recordings = new Map(); // attempts by id
const trials = new Map(); // trials of the present run by number
const measured = { latencies: [], frames: [] };
globalThis.misstep = measured; // for scripts/measure_live.py

let session = null, live = null, liveAt = 0, demoModel = null, runDemonstrations = null;
let opened = null; // what the player plays: "attempt 3" or "trial 2"
let playedModel = null, sent = new Map(), sequence = 0, pushed = false, problemUntil = 0, following = false, learnSince = 0;

const stage = new Stage(byId("stage"));
const plane = new Plane(byId("plane"));
const density = new Density(byId("density"));
const chart = new Chart(byId("costs"), (item) => item.openIt());
const player = new Player(watched);
const panel = new LearningPanel(send);
const list = new AttemptList({
  replay: openAttempt,
  remove: (id) => send({ t: "delete", id }),
  download: (id) => fetchFile(() => `./api/download/${byId("format")?.value ?? "hdf5"}?id=${id}`),
});
const input = new Input(push, pressed);
let link = null;

function send(message) {
  return link ? link.send(message) : false;
}

// ------------------------------------------------------------------------- what the server tells

function hear(message) {
  if (message.t === "f") hearFrame(message);
  else if (message.t === "session") hearSession(message);
  else if (message.t === "model") { demoModel = toModel(message.model); refreshPlane(); }
  else if (message.t === "problem") tellProblem(message.text);
  else if (message.t === "hello") hearHello(message);
}

const toModel = (told) => (told && session ? new Model(told, session.system.columns) : told ? { waiting: told } : null);

function hearHello(message) {
  panel.hello(message.learners);
  byId("system").replaceChildren(...message.systems.map((one) => h("option", { value: one.name, title: one.task }, one.title)));
}

function hearFrame(frame) {
  live = frame;
  liveAt = performance.now();
  const begun = sent.get(frame.n);
  if (begun !== undefined) {
    sent.delete(frame.n);
    measured.waiting = begun; // shown by the next frame of the screen
  }
}

function hearSession(now) {
  const before = session;
  session = now;
  if (!before || before.system.name !== now.system.name) useSystem(now);
  if (before && before.run?.key !== now.run?.key) {
    trials.clear();
    runDemonstrations = null;
    if (opened?.trial) closePlayer();
  }
  if (demoModel?.waiting) demoModel = toModel(demoModel.waiting);
  if (["countdown", "driving", "balancing"].includes(now.mode) && before?.mode !== now.mode) {
    if (before?.mode !== "paused") stage.reset();
    closePlayer();
    document.activeElement?.blur?.();
  }
  if (now.mode === "learning" && before?.mode !== "learning") {
    following = true;
    learnSince = performance.now();
  }
  fetchMissing(before);
  showAll();
}

function useSystem(now) {
  stage.use(now.system);
  plane.use(now.system);
  density.use(now.system);
  recordings.clear();
  trials.clear();
  closePlayer();
  input.size = now.system.actions.length;
  input.oneWay = now.system.one_way;
  byId("system").value = now.system.name;
  byId("column").replaceChildren(...now.system.columns.map((column) => h("option", { value: column.name }, `by ${nameOf(column)}`)));
  byId("column").value = plane.column;
  show(byId("angle-label"), now.system.can_start_at);
  byId("playback").value = now.system.one_way ? "0.1" : "1"; // a stroke lasts a tenth of a second
  panel.prefer(now.system.one_way ? "balanced-mean" : "fall");
}

async function fetchMissing(before) {
  const ids = new Set(session.attempts.map((attempt) => attempt.id));
  const known = new Map(before?.attempts.map((attempt) => [attempt.id, JSON.stringify(attempt)]) ?? []);
  for (const id of recordings.keys()) if (!ids.has(id)) recordings.delete(id);
  for (const attempt of session.attempts) {
    const changed = known.has(attempt.id) && known.get(attempt.id) !== JSON.stringify(attempt);
    if (!recordings.has(attempt.id) || changed) await fetchAttempt(attempt.id);
  }
  const run = session.run;
  if (run) {
    if (run.own_demonstrations && runDemonstrations === null) {
      runDemonstrations = [];
      runDemonstrations = await quietly(getJson(`./api/run/${run.key}/demonstrations`)) ?? [];
    }
    for (const { number } of run.trials) {
      if (trials.has(number)) continue;
      trials.set(number, null);
      const trial = await quietly(getJson(`./api/run/${run.key}/${number}`));
      if (!trial || session.run?.key !== run.key) { trials.delete(number); continue; }
      trials.set(number, trial);
      if (following && number === session.run.trials.length) openTrial(number);
    }
  }
  refreshPlane();
}

async function fetchAttempt(id) {
  const recording = await quietly(getJson(`./api/attempt/${id}`));
  if (recording) recordings.set(id, recording);
  if (recording && opened?.attempt === id) openAttempt(id, true);
}

async function quietly(promise) {
  try { return await promise; } catch { return null; } // gone meanwhile: what is shown next says so
}

// ---------------------------------------------------------------------------- recordings, trials

function openAttempt(id, keepPlace = false) {
  const recording = recordings.get(id);
  if (!recording || !canPlay()) return;
  following = false;
  const place = player.position;
  opened = { attempt: id };
  playedModel = demoModel;
  player.open(recording, !keepPlace);
  if (keepPlace) player.position = Math.min(place, player.duration);
  refreshPlane();
  showAll();
}

function openTrial(number) {
  const trial = trials.get(number);
  if (!trial || !(canPlay() || session.mode === "learning")) return;
  opened = { trial: number };
  playedModel = trial.model ? new Model(trial.model, session.system.columns) : null;
  stage.reset();
  player.open(trial);
  refreshPlane();
  showAll();
}

const canPlay = () => !["countdown", "driving", "balancing"].includes(session.mode);

function closePlayer() {
  following = following && session?.mode === "learning";
  player.close();
  opened = null;
  playedModel = null;
  stage.reset();
  if (session) { refreshPlane(); showAll(); }
}

function watched() {
  if (session.mode === "learning" && opened?.trial) send({ t: "next", trial: opened.trial });
  showAll();
}

function refreshPlane() {
  if (!session) return;
  const shown = session.run?.own_demonstrations ? runDemonstrations ?? [] : [...recordings.values()];
  const until = opened?.trial ?? session.run?.trials.length + 1 ?? 0;
  const tried = session.run && !opened?.attempt ? [...trials].filter(([number, trial]) => trial && number < until).map(([, trial]) => trial) : [];
  plane.change({ shown, tried, model: model() });
  refreshChart();
}

const model = () => (opened ? playedModel : session?.run && lastTrial()?.model && session.mode === "balancing" ? balanceModel() : demoModel?.waiting ? null : demoModel);
const lastTrial = () => trials.get(session.run?.trials.length);
let balanceCache = [null, null];
function balanceModel() {
  const trial = lastTrial();
  if (balanceCache[0] !== trial) balanceCache = [trial, new Model(trial.model, session.system.columns)];
  return balanceCache[1];
}

function refreshChart() {
  const measure = byId("measure").value;
  const shown = session.run?.own_demonstrations ? runDemonstrations ?? [] : session.attempts;
  const items = shown.map((one, i) => ({
    label: `d${i + 1}`, number: i + 1, value: one[measure], outcome: one.outcome, trial: false,
    open: `attempt ${one.id}`, openIt: () => one.id !== undefined && openAttempt(one.id),
  }));
  for (const one of session.run?.trials ?? []) {
    items.push({ label: `t${one.number}`, number: one.number, value: one[measure], outcome: one.outcome, trial: true,
      open: `trial ${one.number}`, openIt: () => openTrial(one.number) });
  }
  setText(byId("costs-title"), measure === "cost" ? `Cost: ${session.system.cost}` : "Time lasted [s]");
  chart.change(items);
}

// ------------------------------------------------------------------------------ what is in words

function showAll() {
  if (!session) return;
  const { mode, run } = session, learning = mode === "learning";
  list.show(session.attempts, session.system, opened?.attempt, session.can_undo && session.drives, Boolean(replay));
  panel.options(session);
  player.showBar();
  showStory();
  showNotice();
  showActions();
  showCallout();
  showSentence();
  showSettings();
  showMarks();
  byId("stage-box").classList.toggle("held", mode === "balancing");
  byId("pads").classList.toggle("can", hasFingers && !opened && session.drives && mode !== "learning");
  const reason = session.fits[byId("learner").value];
  const button = byId("learn");
  show(button, !learning);
  show(byId("halt"), learning);
  button.disabled = !session.drives || Boolean(reason) || !["ready"].includes(mode);
  button.title = reason ?? "";
  setText(button, session.attempts.length && !reason ? `Learn from ${session.attempts.length}` : "Learn");
  show(byId("balance"), Boolean(run?.trials.length) && !learning);
  byId("balance").disabled = !session.drives || !["ready", "balancing"].includes(mode);
  setText(byId("balance"), mode === "balancing" ? "Stop it" : run?.trials.some((t) => t.outcome === "success") ? "Let it balance" : "Try the last one");
  setText(byId("folder"), replay ? "" : `recordings in ${session.folder}`);
}

function showStory() {
  const { mode, run, attempts } = session;
  const succeeded = run?.trials.some((trial) => trial.outcome === "success");
  const now = mode === "balancing" ? "balance" : mode === "learning" || opened?.trial ? "learn" : succeeded ? "balance" : "fail";
  const done = { fail: attempts.length >= 3 || Boolean(run), learn: succeeded, balance: false };
  for (const step of ["fail", "learn", "balance"]) {
    byId(`story-${step}`).className = now === step ? "now" : done[step] ? "done" : "";
  }
}

function showNotice(text = null) {
  const box = byId("notice");
  if (text === null && performance.now() < problemUntil) return;
  const lines = [];
  if (link?.problem) lines.push(link.problem);
  else if (text) lines.push(text);
  else if (!session.drives && !replay) lines.push("Another tab drives; this one watches.");
  else if (session.note) lines.push(session.note[0].toUpperCase() + session.note.slice(1) + (/[.!?…]$/.test(session.note) ? "" : "."));
  const shown = lines.join(" ");
  if (box.dataset.text !== shown) {
    box.dataset.text = shown;
    box.replaceChildren(h("span", {}, shown));
    if (!session.drives && !replay && !link?.problem) box.append(h("button", { id: "take", onclick: () => send({ t: "take" }) }, "Drive here"));
  }
  box.classList.toggle("calm", !link?.problem && !text);
  show(box, Boolean(shown));
}

function tellProblem(text) {
  problemUntil = performance.now() + 6000;
  showNotice(text[0].toUpperCase() + text.slice(1) + (/[.!?…]$/.test(text) ? "" : "."));
  setTimeout(() => session && showNotice(), 6100);
}

const button = (id, text, keys, kind, run) =>
  h("button", { id, className: kind, onclick: run }, text, keys ? h("kbd", {}, keys) : null);

function showActions() {
  const { mode, drives } = session, box = byId("actions");
  const told = `${mode} ${drives} ${opened ? "player" : ""}`;
  if (box.dataset.told === told) return;
  box.dataset.told = told;
  const buttons = {
    ready: [button("begin", "Start", "Space", "primary", () => send({ t: "begin" }))],
    countdown: [button("stop", "Stop", "Esc", "", () => send({ t: "stop" }))],
    driving: [
      button("fail", "It has failed now", "F", "", () => send({ t: "fail" })),
      button("restart", "Again", "R", "", () => send({ t: "restart" })),
      button("stop", "Stop", "Esc", "", () => send({ t: "stop" })),
    ],
    paused: [
      button("resume", "Go on", "Space", "primary", () => send({ t: "resume" })),
      button("restart", "Again", "R", "", () => send({ t: "restart" })),
      button("stop", "Stop", "Esc", "", () => send({ t: "stop" })),
    ],
    ended: [
      button("keep", "Keep it", "Enter", "primary", () => send({ t: "keep" })),
      button("discard", "Throw it away", "⌫", "", () => send({ t: "discard" })),
      button("restart", "Again", "R", "", () => send({ t: "restart" })),
    ],
    learning: [],
    balancing: [
      button("poke-left", "◀ Push", "←", "", () => send({ t: "poke", side: -1 })),
      button("poke-right", "Push ▶", "→", "", () => send({ t: "poke", side: 1 })),
      button("rest", "Stop it", "Esc", "", () => send({ t: "rest" })),
    ],
  }[mode];
  box.replaceChildren(...(drives ? buttons : []));
}

function showCallout() {
  const { mode, pending, system } = session, box = byId("callout");
  let inside = null;
  if (opened?.trial) inside = h("div", {}, h("b", {}, `Trial ${opened.trial}`), `by ${session.run?.learner}`);
  else if (opened) inside = h("div", {}, h("b", {}, "A recording"), "of an attempt");
  else if (mode === "countdown") inside = h("div", {}, h("b", {}, "Get ready"), "← and → push");
  else if (mode === "paused") inside = h("div", {}, h("b", {}, "Paused"), "Space goes on, R starts again");
  else if (mode === "ended" && pending) {
    inside = h("div", {}, h("b", { className: pending.outcome === "success" ? "good" : "bad" }, `It ${pending.sentence}`),
      pending.outcome === "success" ? "You can do it! misstep learns from failures, too: keep it or throw it away." : "A fine failure. Keep it?");
  } else if (mode === "ready" && !session.attempts.length && !session.run) {
    inside = h("div", {}, h("b", {}, system.one_way ? "Press and hold → to strike" : "Take the cart with ← and →"),
      "and fail. Failing is what it learns from.");
  } else if (mode === "ready" && session.run?.trials.some((trial) => trial.outcome === "success")) {
    inside = h("div", {}, h("b", { className: "good" }, "It has learned it"), "let it balance, and push it");
  } else if (mode === "ready") {
    inside = h("div", {}, h("b", {}, session.attempts.length ? "Once more, a little differently" : "Ready"), "Space, or a push, starts");
  } else if (mode === "driving") {
    inside = h("div", {}, h("b", {}, "You drive"), system.one_way ? "let go to end the stroke" : "keep it up for as long as you can");
  } else if (mode === "balancing" && system.pushable && !pushed) {
    inside = h("div", {}, h("b", { className: "good" }, "Push the pole"), "drag its tip with the mouse, or press ← and →");
  } else if (mode === "balancing") {
    inside = h("div", {}, h("b", { className: "good" }, "On its own"), system.pushable ? "should it fall, it starts again" : "from one start after another");
  } else if (mode === "learning" && !session.run?.trials.length) {
    const waited = Math.floor((performance.now() - learnSince) / 1000);
    inside = h("div", {}, h("b", {}, "Learning …"), `from ${session.run?.demonstrations || "your"} attempts${waited > 2 ? `, ${waited} s so far` : ""}`);
  }
  setText(byId("count"), mode === "countdown" ? String(live?.left || session.settings.countdown || "") : "");
  const told = inside?.outerHTML ?? "";
  if (box.dataset.told === told) return;
  box.dataset.told = told;
  box.replaceChildren(...(inside ? [inside] : []));
}

function showSentence() {
  const { run, mode, attempts } = session, box = byId("sentence");
  let text = "";
  if (opened?.trial) text = trials.get(opened.trial)?.sentence ?? "";
  else if (opened?.attempt) {
    const number = attempts.findIndex((attempt) => attempt.id === opened.attempt) + 1;
    text = `Attempt ${number}, as it was recorded. Mark below when it went wrong, or cut it.`;
  } else if (mode === "learning") text = run?.trials.length ? run.trials.at(-1).sentence : "Learning from the attempts …";
  else if (mode === "balancing") text = `What ${run.learner} learned runs on its own now. Push it: no attempt has ever shown that.`;
  else if (run) text = sentenceOfRun(run);
  else if (!attempts.length) text = "Fail a few times first: drive on the left until it goes wrong, and keep the attempt.";
  else if (attempts.length < 3) text = `${attempts.length} failed attempt${attempts.length > 1 ? "s" : ""}: one or two more, each a little different, and it knows where you disagree.`;
  else text = `${attempts.length} attempts: that is enough. Choose a learner and press Learn.`;
  setText(box, text);
}

function sentenceOfRun(run) {
  const count = run.trials.length, success = run.trials.findIndex((trial) => trial.outcome === "success") + 1;
  const said = `${count} trial${count === 1 ? "" : "s"}`;
  if (success) return `The learner ${run.learner} succeeded in trial ${success}. Let it balance, and push it; or look at any trial again in the chart.`;
  if (run.status === "halted") return `The learner ${run.learner} was stopped after ${said}; it can go on under Options.`;
  return `The learner ${run.learner} made ${said} and none succeeded. Keep more attempts, or try a learner that is told more.`;
}

function showSettings() {
  const { settings, drives } = session, speed = SPEEDS.reduce((best, one, i) => (Math.abs(one - settings.speed) < Math.abs(SPEEDS[best] - settings.speed) ? i : best), 0);
  const set = (id, value, text) => {
    const range = byId(id);
    if (document.activeElement !== range && range.value !== String(value)) range.value = value;
    range.disabled = !drives;
    setText(byId(`${id}-out`), text);
  };
  set("strength", Math.round(100 * settings.strength), `${Math.round(100 * settings.strength)} %`);
  set("speed", speed, settings.speed === 1 ? "real time" : `${settings.speed} ×`);
  set("angle", settings.start_angle ?? -31, settings.start_angle === null ? "by chance" : `${signed(settings.start_angle, 0)}°`);
  set("countdown", settings.countdown, settings.countdown ? `${settings.countdown}` : "none");
}

function showMarks() {
  const box = byId("marks"), id = opened?.attempt;
  show(box, id !== undefined && !replay && session.drives);
  if (box.hidden) return;
  const summary = session.attempts.find((attempt) => attempt.id === id);
  const told = JSON.stringify([id, summary?.outcome, summary?.failure_time, summary?.duration]);
  if (box.dataset.told === told) return;
  box.dataset.told = told;
  const mark = (values) => send({ t: "mark", id, outcome: null, failure_time: null, usable: null, ...values });
  const at = () => Math.min(player.position, player.duration);
  box.replaceChildren(
    h("span", { className: "faint" }, "Mark:"),
    button("mark-failed", "it failed here", "", "", () => mark({ failure_time: at() })),
    button("mark-success", "it succeeded", "", "", () => mark({ outcome: "success" })),
    button("mark-unknown", "nobody knows", "", "", () => mark({ outcome: "unknown" })),
    button("cut-before", "cut before here", "", "", () => mark({ usable: [at(), player.duration] })),
    button("cut-after", "cut after here", "", "", () => mark({ usable: [0, at()] })),
    h("span", { className: "faint" }, summary?.failure_time != null ? `failed at ${summary.failure_time.toFixed(2)} s` : summary?.outcome ?? ""));
}

// ------------------------------------------------------------------------------ what one presses

function push(values, when) {
  sequence += 1;
  if (session?.mode === "balancing") {
    if (values[0]) { send({ t: "poke", side: values[0] }); pushed = true; showCallout(); }
    return;
  }
  if (send({ t: "input", v: values, n: sequence }) && session?.mode === "driving") {
    sent.clear();
    sent.set(sequence, when);
  }
}

// Returns whether the key meant something.
function pressed(name) {
  if (!session || replay) return replay ? pressedInPlayer(name) : false;
  const { mode, drives } = session;
  if (opened && pressedInPlayer(name)) return true;
  if (!drives) return false;
  const does = {
    push: { ready: "begin" },
    " ": { ready: "begin", paused: "resume", driving: "pause", countdown: "stop", ended: "keep" },
    Enter: { ready: "begin", ended: "keep" },
    Backspace: { ended: "discard", paused: "discard" },
    r: { ready: "restart", countdown: "restart", driving: "restart", paused: "restart", ended: "restart" },
    f: { driving: "fail", paused: "fail" },
    Escape: { countdown: "stop", driving: "stop", paused: "stop", balancing: "stop", learning: "stop" },
  }[name]?.[mode];
  if (opened && name === "push") return false;
  if (name === "Backspace" && mode === "paused") { send({ t: "stop" }); return true; }
  if (does) send({ t: does });
  return Boolean(does);
}

function pressedInPlayer(name) {
  if (name === " ") player.toggle();
  else if (name === ",") player.step(-1);
  else if (name === ".") player.step(1);
  else if (name === "Escape" && session.mode !== "learning" && !replay) closePlayer();
  else if ((name === "PageUp" || name === "PageDown") && opened?.trial) openTrial(opened.trial + (name === "PageUp" ? -1 : 1));
  else return false;
  return true;
}

function startControls() {
  byId("learn").addEventListener("click", () => { closePlayer(); panel.learn(); });
  byId("halt").addEventListener("click", () => send({ t: "halt" }));
  byId("balance").addEventListener("click", () => { const t = session.mode === "balancing" ? "rest" : "balance"; closePlayer(); send({ t }); });
  byId("undo").addEventListener("click", () => send({ t: "undo" }));
  byId("leave-player").addEventListener("click", closePlayer);
  byId("system").addEventListener("change", (event) => {
    if (!send({ t: "system", name: event.target.value })) event.target.value = session.system.name;
  });
  byId("column").addEventListener("change", (event) => { plane.column = event.target.value; plane.stale = true; });
  byId("measure").addEventListener("change", refreshChart);
  byId("playback").addEventListener("change", () => send({ t: "pace", watch: player.speed !== "full" }));
  for (const id of ["strength", "speed", "angle", "countdown"]) {
    byId(id).addEventListener("input", sendSettings);
    byId(id).addEventListener("change", (event) => event.target.blur());
  }
  addEventListener("keydown", (event) => {
    if ((event.ctrlKey || event.metaKey) && event.key === "z" && session?.can_undo) { event.preventDefault(); send({ t: "undo" }); }
  });
  document.addEventListener("visibilitychange", () => send({ t: "hidden", hidden: document.hidden }));
  startUploads();
  startHand();
  panel.update = () => session && showAll();
}

function sendSettings() {
  const angle = Number(byId("angle").value);
  send({
    t: "settings", strength: Number(byId("strength").value) / 100, speed: SPEEDS[Number(byId("speed").value)],
    start_angle: angle < -30 ? null : angle, countdown: Number(byId("countdown").value),
  });
}

function startUploads() {
  const add = async (files) => {
    for (const file of files) {
      try {
        const count = await upload(file);
        tellProblem(`${count} recording${count === 1 ? "" : "s"} added from ${file.name}`);
      } catch (error) {
        tellProblem(`${file.name} was not added: ${error.message === "Failed to fetch" ? "the server refused it or is gone" : error.message}`);
      }
    }
  };
  byId("upload").addEventListener("click", () => byId("file").click());
  byId("file").addEventListener("change", (event) => { add([...event.target.files]); event.target.value = ""; });
  addEventListener("dragover", (event) => { event.preventDefault(); document.body.classList.add("dropping"); });
  addEventListener("dragleave", (event) => { if (!event.relatedTarget) document.body.classList.remove("dropping"); });
  addEventListener("drop", (event) => {
    event.preventDefault();
    document.body.classList.remove("dropping");
    add([...event.dataTransfer.files]);
  });
}

// The mouse, or a finger, at the pole while the policy balances it; told once a frame.
let handAt = null, handTold = null;
function startHand() {
  const canvas = byId("stage");
  canvas.addEventListener("pointerdown", (event) => {
    if (session?.mode !== "balancing" || !session.drives || !session.system.pushable) return;
    handAt = event.clientX;
    pushed = true;
    canvas.setPointerCapture(event.pointerId);
    showCallout();
  });
  canvas.addEventListener("pointermove", (event) => { if (handAt !== null) handAt = event.clientX; });
  for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, () => { handAt = null; });
}

function tellHand() {
  const x = handAt === null ? null : stage.placeAt(handAt);
  if (x === handTold) return;
  handTold = x;
  send({ t: "push", x });
}

async function fetchFile(address) {
  try {
    const answer = await fetch(address());
    if (!answer.ok) throw new Error((await answer.json()).problem);
    const name = /filename\*=utf-8''(.+)$/.exec(answer.headers.get("content-disposition"))[1];
    const url = URL.createObjectURL(await answer.blob());
    const anchor = h("a", { href: url, download: decodeURIComponent(name) });
    document.body.append(anchor);
    anchor.click();
    anchor.remove();
    setTimeout(() => URL.revokeObjectURL(url), 60000);
  } catch (error) {
    tellProblem(`The download failed: ${error.message}`);
  }
}

function saveRun() {
  byId("save-menu").open = false;
  if (session.run) fetchFile(() => `./api/download-run/${session.run.name}`);
  else tellProblem("There is no run yet: let it learn first, or open an earlier run under Options");
}

// --------------------------------------------------------------------------------- every frame

// States come 50 times a second and frames 60 times: in between, a state goes on as it moves.
function liveView(now) {
  const { system, settings, mode } = session, observation = live.o.map((value) => value ?? 0);
  if (system.drawing === "cartpole" && ["driving", "balancing"].includes(mode)) {
    const rate = mode === "driving" ? settings.speed : 1;
    const ahead = Math.min(((now - liveAt) / 1000) * rate, 1.2 * system.dt);
    observation[0] += ahead * observation[1];
    observation[2] += ahead * observation[3];
  }
  return { observation, action: live.a, time: live.k * system.dt, step: live.k, hand: live.hold };
}

const livePath = { observations: [], actions: [], k: -1 };
function extendPath() {
  if (live.k < livePath.k || session.mode === "ready") { livePath.observations = []; livePath.actions = []; livePath.k = -1; }
  if (live.k > livePath.k && session.mode !== "ready") {
    livePath.k = live.k;
    livePath.observations.push(live.o);
    livePath.actions.push(live.a);
    if (livePath.actions.length > 4000) { livePath.observations.shift(); livePath.actions.shift(); }
  }
}

let lastFrame = 0, lastFigures = 0;
function drawFrame(now) {
  requestAnimationFrame(drawFrame);
  const seconds = Math.min((now - lastFrame) / 1000, 0.1);
  if (lastFrame) keepLast(measured.frames, now - lastFrame);
  lastFrame = now;
  if (!session || (!live && !replay)) return;
  input.poll(now);
  tellHand();
  player.advance(seconds);
  const playing = player.recording !== null;
  const view = playing ? player.view() : live ? liveView(performance.now()) : null;
  if (!view) return;
  if (!playing) { extendPath(); if (["countdown", "learning"].includes(session.mode)) showCallout(); }
  stage.draw(view);
  const path = playing ? player.recording : livePath;
  plane.draw(path, playing ? view.step : livePath.actions.length - 1, view.action);
  const used = model(), conditional = used ? used.at(view.observation) : null;
  density.draw(used, conditional, view.action[0]);
  showEpsilon(conditional);
  showHud(view);
  panel.here(now, ["driving", "balancing", "learning"].includes(session.mode) || playing ? conditional : null, view.action[0], session.system);
  chart.draw(opened?.trial ? `trial ${opened.trial}` : opened?.attempt ? `attempt ${opened.attempt}` : null);
  if (measured.waiting !== undefined) {
    keepLast(measured.latencies, performance.now() - measured.waiting);
    measured.waiting = undefined;
  }
  if (now - lastFigures > 700) { lastFigures = now; showFigures(); }
}

function keepLast(values, value) {
  values.push(value);
  if (values.length > MEASURED) values.shift();
}

function showEpsilon(conditional) {
  const used = model()?.told;
  const donut = !used?.own || used.donut ? (used?.own ? "donut: where it goes" : "donut") : "donut, not its way";
  setText(byId("density-legend").children[1], donut);
  const value = conditional?.epsilon ?? 0;
  setText(byId("epsilon-value"), conditional ? `ε = ${value.toFixed(2)}` : "ε  –");
  byId("epsilon-bar").style.transform = `scaleX(${value.toFixed(3)})`;
}

function showHud(view) {
  const { system } = session, box = byId("hud");
  const rows = [["time", `${view.time.toFixed(2)} s`]];
  const angle = system.columns.findIndex((column) => column.unit === "rad");
  const main = angle >= 0 ? angle : 0;
  rows.push([nameOf(system.columns[main]), `${signed(inShownUnit(system.columns[main], view.observation[main]))} ${shownUnit(system.columns[main])}`]);
  rows.push([nameOf(system.actions[0]), `${signed(view.action[0])} ${shownUnit(system.actions[0])}`]);
  if (box.childElementCount !== 2 * rows.length) box.replaceChildren(...rows.flatMap(() => [h("span"), h("b")]));
  rows.forEach(([name, value], i) => { setText(box.children[2 * i], name); setText(box.children[2 * i + 1], value); });
}

const quantile = (values, q) => [...values].sort((a, b) => a - b)[Math.min(values.length - 1, Math.floor(q * values.length))];

function showFigures() {
  const { latencies, frames } = measured;
  if (frames.length > 20) setText(byId("fps"), `${Math.round(1000 / quantile(frames, 0.5))} frames/s`);
  if (replay) return;
  setText(byId("latency"), latencies.length ? `key to screen ${quantile(latencies, 0.5).toFixed(0)} ms (95 %: ${quantile(latencies, 0.95).toFixed(0)} ms)` : "key to screen –");
  setText(byId("late"), live.ticks ? `${live.late} of ${live.ticks} ticks late` : "");
  setText(byId("link-state"), link.isOpen ? "● connected" : "○ not connected");
}

function showLegends() {
  const item = (mark, colour, text, title = "") => h("span", { "data-mark": mark, style: `--c: var(--${colour})`, title }, text);
  byId("plane-legend").replaceChildren(
    item("●", "shown", "attempts"), item("■", "path", "trials before"), item("◯", "mix", "mixture, 3 σ"), item("━", "path", "now"));
  byId("density-legend").replaceChildren(
    item("▬", "shown", "usual", "what the attempts did in states like this one"),
    item("━", "mix", "", "the same with a hole where they failed: the more they disagree, the deeper"),
    item("▲", "path", "now", "what is being done in this very moment"));
  byId("epsilon").replaceChildren(
    h("b", { id: "epsilon-value" }, "ε"), h("div", { className: "gauge" }, h("i", { id: "epsilon-bar" })),
    h("small", {}, h("span", {}, "they agree: repeat"), h("span", {}, "they disagree: avoid")));
}

// -------------------------------------------------------------------------------------- the start

function startReplay() {
  document.body.classList.add("replay");
  hearSession({ ...replay.session, drives: false, mode: "ready", runs: [], note: "" });
  session.attempts.forEach((attempt, i) => recordings.set(attempt.id, replay.recordings[i]));
  session.run?.trials.forEach((trial, i) => trials.set(trial.number, replay.trials[i]));
  if (session.run?.trials.length) openTrial(session.run.trials.length); else if (session.attempts.length) openAttempt(session.attempts[0].id);
  show(byId("leave-player"), false);
}

async function startLive() {
  link = new Link(hear, (problem) => {
    link.problem = problem;
    if (!problem) input.last = "";
    if (session) showNotice();
  });
  startControls();
  const told = await quietly(getJson("./api/formats"));
  fillSaveMenu(told?.formats ?? [], { fetchFile, saveRun });
}

startTheme();
onTheme(() => { plane.stale = true; chart.stale = true; });
showLegends();
startHelp();
if (replay) startReplay(); else startLive();
if (replay) byId("column").addEventListener("change", (event) => { plane.column = event.target.value; plane.stale = true; });
requestAnimationFrame(drawFrame);
