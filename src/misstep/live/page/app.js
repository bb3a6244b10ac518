// The page: what the server tells, what the person does, and one picture of both each frame.

import { meaningOf, showActions } from "misstep/actions.js";
import { AttemptList } from "misstep/attempts.js";
import { Chart } from "misstep/chart.js";
import { Density } from "misstep/density.js";
import { fillSaveMenu, startHelp } from "misstep/dialogs.js";
import { byId, h, nameOf, setText } from "misstep/dom.js";
import { Figures } from "misstep/figures.js";
import { download, startUploads } from "misstep/files.js";
import { Hand } from "misstep/hand.js";
import { showEpsilon, showHud, showLegends } from "misstep/hud.js";
import { Input } from "misstep/input.js";
import { LearningPanel } from "misstep/learning.js";
import { Library } from "misstep/library.js";
import { getJson, Link } from "misstep/link.js";
import { showMarks } from "misstep/marks.js";
import { Model } from "misstep/model.js";
import { Notice } from "misstep/notice.js";
import { LivePath, liveView } from "misstep/path.js";
import { Plane } from "misstep/plane.js";
import { Player } from "misstep/player.js";
import { showSettings, startSettings } from "misstep/settings.js";
import { Stage } from "misstep/stage.js";
import { onTheme, startTheme } from "misstep/theme.js";
import { Viewer } from "misstep/viewer.js";
import { balanceLabel, callout, calloutElement, sentence, story } from "misstep/words.js";

const replay = JSON.parse(byId("replay-data").textContent || "null");
const hasFingers = matchMedia("(pointer: coarse)").matches || (navigator.maxTouchPoints > 0 && innerWidth < 1100);

// What is known of the server: the last account of how things are, the last state and when it came,
// the mixture of the attempts, when it began to learn; and whether it is a touch screen.
const state = { session: null, live: null, liveAt: 0, demoModel: null, learnSince: 0, hasFingers };
let link = null, sequence = 0, pushed = false, modelWaiting = null, policyModel = [null, null];

const send = (message) => (link ? link.send(message) : false);
const fetchFile = (address) => download(address, (text) => notice.tell(text));

const stage = new Stage(byId("stage"));
const plane = new Plane(byId("plane"));
const density = new Density(byId("density"));
const chart = new Chart(byId("costs"), (item) => item.openIt());
const player = new Player(() => viewer.watched());
const library = new Library(arrived);
const viewer = new Viewer({ state, library, player, stage, send, refresh: () => { refreshPlane(); showAll(); } });
const panel = new LearningPanel(send);
const notice = new Notice({ state, link: () => link, send, isReplay: Boolean(replay) });
const figures = globalThis.misstep = new Figures(); // also for scripts/measure_live.py
const path = new LivePath();
const hand = new Hand(byId("stage"), { state, stage, send, touched: () => { pushed = true; showCallout(); } });
const list = new AttemptList({
  replay: (id) => viewer.openAttempt(id),
  remove: (id) => send({ t: "delete", id }),
  download: (id) => fetchFile(`./api/download/${byId("format")?.value ?? "hdf5"}?id=${id}`),
});
const input = new Input(push, pressed);

// ------------------------------------------------------------------------- what the server tells

function hear(message) {
  if (message.t === "f") hearFrame(message);
  else if (message.t === "session") hearSession(message);
  else if (message.t === "model") { modelWaiting = message; takeModel(); refreshPlane(); }
  else if (message.t === "problem") hearProblem(message.text);
  else if (message.t === "hello") hearHello(message);
}

function hearHello(message) {
  panel.hello(message.learners);
  byId("system").replaceChildren(...message.systems.map((one) => h("option", { value: one.name, title: one.task }, one.title)));
}

function hearProblem(text) {
  notice.tell(text);
  if (state.session) byId("system").value = state.session.system.name; // where another was refused
}

function hearFrame(frame) {
  state.live = frame;
  state.liveAt = performance.now();
  figures.acknowledged(frame.n);
}

// A mixture is of the system that was told of last, or of the one that is told of next.
function takeModel() {
  if (!state.session || !modelWaiting) return;
  const { columns } = state.session.system, told = modelWaiting.model;
  const fits = !told || told.state.every((name) => columns.some((column) => column.name === name));
  if (!fits) return;
  state.demoModel = told ? new Model(told, columns) : null;
  modelWaiting = null;
}

function hearSession(now) {
  const before = state.session;
  state.session = now;
  if (!before || before.system.name !== now.system.name) useSystem(now);
  takeModel();
  if (before && before.run?.key !== now.run?.key) {
    library.clearRun();
    if (viewer.trial !== null) viewer.close();
  }
  if (["countdown", "driving", "balancing"].includes(now.mode) && before?.mode !== now.mode) {
    if (before?.mode !== "paused") stage.reset();
    viewer.close();
    document.activeElement?.blur?.();
  }
  if (now.mode === "learning" && before?.mode !== "learning") {
    viewer.following = true;
    state.learnSince = performance.now();
  }
  if (before?.watch !== now.watch) panel.pace(now.watch, now.system.one_way);
  if (now.drives && !before?.drives && now.mode === "learning") viewer.tellWatched();
  library.fetchMissing(now);
  refreshPlane();
  showAll();
}

function useSystem(now) {
  for (const view of [stage, plane, density]) view.use(now.system);
  library.clear();
  state.demoModel = null;
  viewer.close();
  input.use(now.system);
  byId("system").value = now.system.name;
  byId("column").replaceChildren(...now.system.columns.map((column) => h("option", { value: column.name }, `by ${nameOf(column)}`)));
  byId("column").value = plane.column;
  panel.pace(now.watch, now.system.one_way);
  panel.prefer(now.run?.learner ?? (now.system.one_way ? "balanced-mean" : "fall"));
}

function arrived(kind, number) {
  if (kind === "attempt" && viewer.attempt === number) viewer.openAttempt(number, true);
  if (kind === "trial") viewer.trialCame(number);
  refreshPlane();
}

// -------------------------------------------------------------------------------- what is shown

// The mixture that is shown: of what is open, of the policy at work, or of the attempts.
function model() {
  const { session } = state;
  if (viewer.isOpen) return viewer.model;
  const last = session.mode === "balancing" ? library.trials.get(session.run?.trials.length) : null;
  if (!last?.model) return state.demoModel;
  if (policyModel[0] !== last) policyModel = [last, new Model(last.model, session.system.columns)];
  return policyModel[1];
}

function refreshPlane() {
  const { session } = state;
  if (!session) return;
  const until = viewer.trial ?? Infinity, tried = viewer.attempt === null ? [...library.trials] : [];
  plane.change({
    shown: library.shown(session), model: model(),
    tried: tried.filter(([number]) => number < until).map(([, trial]) => trial),
  });
  refreshChart();
}

function refreshChart() {
  const { session } = state, measure = byId("measure").value;
  const shown = session.run?.own_demonstrations ? library.demonstrations ?? [] : session.attempts;
  const bar = (one, kind, number, openIt) => ({
    kind, number, value: one[measure], outcome: one.outcome, trial: kind === "trial", label: `${kind[0] === "t" ? "t" : "d"}${number}`,
    open: `${kind} ${one.id ?? number}`, openIt,
  });
  setText(byId("costs-title"), measure === "cost" ? `Cost: ${session.system.cost}` : "Time lasted [s]");
  chart.change([
    ...shown.map((one, i) => bar(one, "attempt", i + 1, () => one.id !== undefined && viewer.openAttempt(one.id))),
    ...(session.run?.trials ?? []).map((one) => bar(one, "trial", one.number, () => viewer.openTrial(one.number))),
  ]);
}

function showAll() {
  const { session } = state;
  if (!session) return;
  const learning = session.mode === "learning";
  list.show(session.attempts, session.system, viewer.attempt, session.can_undo && session.drives, Boolean(replay));
  panel.options(session);
  player.showBar();
  for (const [step, how] of Object.entries(story(session, viewer))) {
    byId(`story-${step}`).className = how;
    if (how === "now") byId(`story-${step}`).setAttribute("aria-current", "step"); else byId(`story-${step}`).removeAttribute("aria-current");
  }
  notice.show();
  showActions(session, viewer.isOpen, send);
  showCallout();
  setText(byId("sentence"), sentence(state, viewer, library));
  showSettings(session);
  showMarks(session, viewer.attempt, player, !replay && session.drives, send);
  panel.buttons(session, balanceLabel(session));
  byId("stage-box").classList.toggle("held", session.mode === "balancing");
  byId("pads").className = `pads${hasFingers && !viewer.isOpen && session.drives && !learning ? " can" : ""}`;
  byId("system").disabled = !session.drives || !["ready", "ended"].includes(session.mode);
  setText(byId("folder"), replay ? "" : `recordings in ${session.folder}`);
}

function showCallout() {
  const { session, live } = state, box = byId("callout");
  setText(byId("count"), session.mode === "countdown" ? String(live?.left || session.settings.countdown || "") : "");
  const told = callout(state, viewer, pushed), text = told?.join("|") ?? "";
  if (box.dataset.told === text) return;
  box.dataset.told = text;
  box.replaceChildren(...(told ? [calloutElement(told)] : []));
}

// ------------------------------------------------------------------------------ what one presses

function push(values, when) {
  const { session } = state;
  if (session?.mode === "balancing") {
    if (values[0] && session.system.pushable) { send({ t: "poke", side: values[0] }); pushed = true; showCallout(); }
    return;
  }
  sequence += 1;
  if (send({ t: "input", v: values, n: sequence }) && session?.mode === "driving") figures.pushed(sequence, when);
}

// Returns whether the key meant something.
function pressed(name) {
  const { session } = state;
  if (!session) return false;
  if (viewer.isOpen && pressedInPlayer(name)) return true;
  if (replay || !session.drives || (viewer.isOpen && name === "push")) return false;
  const does = meaningOf(name, session.mode);
  if (does) send({ t: does });
  return Boolean(does);
}

function pressedInPlayer(name) {
  if (name === " ") player.toggle();
  else if (name === ",") player.step(-1);
  else if (name === ".") player.step(1);
  else if (name === "Escape" && state.session.mode !== "learning" && !replay) viewer.close();
  else if ((name === "PageUp" || name === "PageDown") && viewer.trial !== null) viewer.openTrial(viewer.trial + (name === "PageUp" ? -1 : 1));
  else return false;
  return true;
}

function startControls() {
  const balance = () => { const t = state.session.mode === "balancing" ? "rest" : "balance"; viewer.close(); send({ t }); };
  const clicks = {
    learn: () => { viewer.close(); panel.learn(); }, halt: () => send({ t: "halt" }), balance,
    undo: () => send({ t: "undo" }), "leave-player": () => viewer.close(),
  };
  for (const [id, run] of Object.entries(clicks)) byId(id).addEventListener("click", run);
  byId("system").addEventListener("change", (event) => {
    if (!send({ t: "system", name: event.target.value })) event.target.value = state.session.system.name;
  });
  byId("playback").addEventListener("change", () => { if (state.session.drives) send({ t: "pace", watch: player.speed !== "full" }); });
  addEventListener("keydown", (event) => {
    const typing = event.target.closest?.("input[type=number]");
    if ((event.ctrlKey || event.metaKey) && event.key === "z" && !typing && state.session?.can_undo) { event.preventDefault(); send({ t: "undo" }); }
  });
  document.addEventListener("visibilitychange", () => send({ t: "hidden", hidden: document.hidden }));
  startSettings(send);
  startUploads((text) => notice.tell(text));
  panel.update = () => state.session && showAll();
}

function saveRun() {
  byId("save-menu").open = false;
  if (state.session.run) fetchFile(`./api/download-run/${state.session.run.name}`);
  else notice.tell("There is no run yet: let it learn first, or open an earlier run under Options");
}

// --------------------------------------------------------------------------------- every frame

function drawFrame(now) {
  requestAnimationFrame(drawFrame);
  const seconds = figures.frame(now), { session, live } = state;
  if (!session || (!live && !replay)) return;
  input.poll(now);
  hand.tell();
  player.advance(seconds);
  const playing = player.recording !== null;
  const view = playing ? player.view() : live ? liveView(state, performance.now()) : null;
  if (!view) return;
  if (!playing) { path.extend(state); if (["countdown", "learning"].includes(session.mode)) showCallout(); }
  stage.draw(view);
  plane.draw(playing ? player.recording : path, playing ? view.step : path.actions.length - 1, view.action);
  const used = model(), conditional = used ? used.at(view.observation) : null;
  density.draw(used, conditional, view.action[0]);
  showEpsilon(used, conditional);
  showHud(session.system, view);
  panel.here(now, ["driving", "balancing", "learning"].includes(session.mode) || playing ? conditional : null, view.action[0], session.system);
  chart.draw(viewer.name);
  figures.drawn();
  figures.show(now, live, link);
}

// -------------------------------------------------------------------------------------- the start

function startReplay() {
  document.body.classList.add("replay");
  byId("leave-player").remove();
  hearSession({ ...replay.session, drives: false, mode: "ready", runs: [], note: "", watch: true });
  const { attempts, run } = state.session;
  attempts.forEach((attempt, i) => library.recordings.set(attempt.id, replay.recordings[i]));
  run?.trials.forEach((trial, i) => library.trials.set(trial.number, replay.trials[i]));
  if (run?.own_demonstrations) library.demonstrations = replay.recordings;
  if (run?.trials.length) viewer.openTrial(run.trials.length); else if (attempts.length) viewer.openAttempt(attempts[0].id);
}

async function startLive() {
  link = new Link(hear, (problem) => {
    link.problem = problem;
    if (!problem) input.last = "";
    notice.show();
  });
  startControls();
  const told = await getJson("./api/formats").catch(() => null); // without them, only the menu lacks
  fillSaveMenu(told?.formats ?? [], { fetchFile, saveRun });
}

startTheme();
onTheme(() => { plane.stale = true; chart.stale = true; });
showLegends();
startHelp();
byId("column").addEventListener("change", (event) => { plane.column = event.target.value; plane.stale = true; });
byId("measure").addEventListener("change", refreshChart);
if (replay) startReplay(); else startLive();
requestAnimationFrame(drawFrame);
