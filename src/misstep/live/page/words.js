// What the page says in words: the callout above the stage, the sentence, the step of the story.

import { h } from "misstep/dom.js";

const succeeded = (run) => Boolean(run?.trials.some((trial) => trial.outcome === "success"));

// The callout: [words in bold, "good", "bad" or "" for them, the rest]; null for none.
export function callout(state, viewer, pushed) {
  const { session } = state, { mode, pending, system, run } = session;
  if (viewer.trial !== null) return [`Trial ${viewer.trial}`, "", `by ${run?.learner}`];
  if (viewer.attempt !== null) return ["A recording", "", "of an attempt"];
  if (mode === "countdown") return ["Get ready", "", system.one_way ? "hold → to strike" : "← and → push"];
  if (mode === "driving") return ["You drive", "", system.one_way ? "let go to end the stroke" : "keep it up for as long as you can"];
  if (mode === "paused") return ["Paused", "", state.hasFingers ? "go on, or start again" : "Space goes on, R starts again"];
  if (mode === "ended" && pending) return calloutOfEnd(pending);
  if (mode === "balancing") return calloutOfBalancing(system, pushed);
  if (mode === "learning" && !run?.trials.length) {
    const waited = Math.floor((performance.now() - state.learnSince) / 1000);
    return ["Learning …", "", `from ${run?.demonstrations || "your"} attempts${waited > 2 ? `, ${waited} s so far` : ""}`];
  }
  return mode === "ready" ? calloutOfReady(session, state.hasFingers) : null;
}

function calloutOfEnd(pending) {
  const won = pending.outcome === "success";
  const rest = won ? "You can do it! misstep learns from failures, too: keep it or throw it away." : "A fine failure. Keep it?";
  return [`It ${pending.sentence}`, won ? "good" : "bad", rest];
}

function calloutOfBalancing(system, pushed) {
  if (!system.pushable) return ["On its own", "good", "from one start after another"];
  if (!pushed) return ["Push the pole", "good", "drag its tip, or press ← and →"];
  return ["On its own", "good", "should it fall, it starts again"];
}

function calloutOfReady({ attempts, run, system }, hasFingers) {
  if (succeeded(run)) return ["It has learned it", "good", system.pushable ? "let it balance, and push it" : "let it run on its own"];
  if (attempts.length || run) return [attempts.length ? "Once more, a little differently" : "Ready", "", hasFingers ? "a push starts it" : "Space, or a push, starts"];
  const how = system.one_way ? "Press and hold → to strike" : system.pushable ? "Take the cart with ← and →" : "Push with ← and →";
  return [how, "", "and fail. Failing is what it learns from."];
}

export function calloutElement(told) {
  const [strong, kind, rest] = told;
  return h("div", {}, h("b", { className: kind }, strong), rest);
}

export function sentence(state, viewer, library) {
  const { run, mode, attempts, system, drives } = state.session;
  if (viewer.trial !== null) return library.trials.get(viewer.trial)?.sentence ?? "";
  if (viewer.attempt !== null) {
    const number = attempts.findIndex((attempt) => attempt.id === viewer.attempt) + 1;
    return `Attempt ${number}, as it was recorded.${drives ? " Mark below when it went wrong, or cut it." : ""}`;
  }
  if (mode === "learning") return run?.trials.length ? run.trials.at(-1).sentence : "Learning from the attempts …";
  if (mode === "balancing") {
    return `What ${run.learner} learned runs on its own now.${system.pushable ? " Push it: no attempt has ever shown that." : ""}`;
  }
  if (run) return sentenceOfRun(run, system);
  if (!attempts.length) return "Fail a few times first: drive until it goes wrong, and keep the attempt.";
  if (attempts.length < 3) return `${attempts.length} attempt${attempts.length > 1 ? "s" : ""}: one or two more, each a little different, and it knows where you disagree.`;
  return `${attempts.length} attempts: that is enough. Choose a learner and press Learn.`;
}

function sentenceOfRun(run, system) {
  const count = run.trials.length, success = run.trials.findIndex((trial) => trial.outcome === "success") + 1;
  const said = `${count} trial${count === 1 ? "" : "s"}`;
  const next = system.pushable ? "Let it balance, and push it" : "Let it run on its own";
  if (success) return `The learner ${run.learner} succeeded in trial ${success}. ${next}; or look at any trial again in the chart.`;
  if (run.status === "halted") return `The learner ${run.learner} was stopped after ${said}; it can go on under Options.`;
  return `The learner ${run.learner} made ${said} and none succeeded. Keep more attempts, or try a learner that is told more.`;
}

// The three steps of the story: "now", "done" or "" for each.
export function story({ mode, run, attempts }, viewer) {
  let now = succeeded(run) ? "balance" : "fail";
  if (mode === "balancing") now = "balance";
  else if (mode === "learning" || viewer.trial !== null) now = "learn";
  const done = { fail: attempts.length >= 3 || Boolean(run), learn: succeeded(run), balance: false };
  return Object.fromEntries(Object.keys(done).map((step) => [step, now === step ? "now" : done[step] ? "done" : ""]));
}

export function balanceLabel({ mode, run, system }) {
  if (mode === "balancing") return "Stop it";
  if (!succeeded(run)) return "Try the last one";
  return system.pushable ? "Let it balance" : "Let it run";
}

// A sentence as people write it: a capital at its beginning and a full stop at its end.
export const asSentence = (text) => text[0].toUpperCase() + text.slice(1) + (/[.!?…]$/.test(text) ? "" : ".");
