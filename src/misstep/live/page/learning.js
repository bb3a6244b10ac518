// The panel of learning: which learner, its options, and the plain sentences.

import { byId, h, nameOf, setText, show, signed, withUnit } from "misstep/dom.js";

const RUNGS = [
  "Rung 0 · is told nothing more",
  "Rung 1 · is told whether an attempt succeeded",
  "Rung 2 · is told when it went wrong",
  "Rung 3 · is told what each step cost",
  "Rung 4 · is told the cost, and learns how the system responds",
];

export class LearningPanel {
  constructor(send) {
    this.send = send;
    this.spoken = 0;
    byId("learner").addEventListener("change", () => this.explain());
  }

  hello(learners) {
    this.learners = learners;
    const select = byId("learner"), chosen = select.value;
    select.replaceChildren(...RUNGS.map((title, rung) => h("optgroup", { label: title },
      ...learners.filter((one) => one.rung === rung).map((one) => h("option", { value: one.name }, `${one.name} · rung ${one.rung}`)))));
    this.prefer(chosen);
  }

  prefer(name) {
    if (this.learners?.some((one) => one.name === name)) byId("learner").value = name;
    this.explain();
  }

  get learner() { return this.learners?.find((one) => one.name === byId("learner").value); }

  explain() {
    const one = this.learner;
    this.suggest();
    if (one) setText(byId("learner-says"), `${one.sentence} It is told ${one.told}${this.sees()}.`);
    this.update?.();
  }

  // Which columns the policy may see, unless somebody has chosen: all where the dynamics are learned.
  suggest() {
    if (!this.suggested) return;
    const all = this.learner?.rung >= 4;
    for (const box of document.querySelectorAll("#columns input")) {
      if (!this.touched) box.checked = all || this.suggested.includes(box.value);
      if (box.disabled) box.checked = false;
    }
  }

  sees() {
    const boxes = [...document.querySelectorAll("#columns input")], chosen = boxes.filter((box) => box.checked);
    if (!chosen.length || chosen.length === boxes.length) return "";
    const named = (some) => some.map((box) => box.dataset.name).join(" and ");
    const others = boxes.filter((box) => !box.checked);
    return chosen.length <= others.length ? `, and sees ${named(chosen)} alone` : `, and sees all but ${named(others)}`;
  }

  // Columns, number of trials, seed, and the runs that are kept; rebuilt only when they change.
  options(session) {
    const told = JSON.stringify([session.system.name, session.runs, session.still]);
    if (told === this.before) return;
    const same = this.system === session.system.name;
    const chosen = [...document.querySelectorAll("#columns input:checked")].map((box) => box.value);
    if (!same) this.touched = false;
    this.suggested = session.system.suggested;
    const trials = same ? byId("max-trials").value : 20, seed = same ? byId("seed").value : 0;
    this.before = told;
    this.system = session.system.name;
    const columns = session.system.columns.map((column) => h("label", {},
      h("input", { type: "checkbox", value: column.name, checked: chosen.includes(column.name),
        disabled: session.still.includes(column.name), "data-name": nameOf(column), onchange: () => { this.touched = true; this.explain(); } }),
      `${nameOf(column)} (${column.name})${session.still.includes(column.name) ? ": it never varied" : ""}`));
    const runs = session.runs.map((name) => h("div", { className: "row" },
      h("code", { className: "grow" }, name),
      h("button", { onclick: () => this.ask("open_run", name) }, "Open"),
      h("button", { onclick: () => this.ask("resume_run", name) }, "Go on")));
    byId("more-sheet").replaceChildren(
      h("h3", {}, "What the policy may see"), h("div", { id: "columns" }, ...columns),
      h("h3", {}, "Trials"),
      h("div", { className: "row" },
        h("label", {}, "at most", h("input", { id: "max-trials", type: "number", min: 1, max: 200, value: trials })),
        h("label", {}, "seed", h("input", { id: "seed", type: "number", min: 0, max: 2147483647, value: seed }))),
      h("h3", {}, "Earlier runs"), ...(runs.length ? runs : [h("p", { className: "faint" }, "None yet.")]));
    this.explain();
  }

  ask(kind, name) {
    byId("more").open = false;
    this.send({ t: kind, name });
  }

  learn() {
    const bounded = (id, low, high) => Math.min(high, Math.max(low, Math.round(Number(byId(id).value)) || low));
    this.send({
      t: "learn",
      learner: byId("learner").value,
      state: [...document.querySelectorAll("#columns input:checked")].map((box) => box.value),
      max_trials: bounded("max-trials", 1, 200),
      seed: bounded("seed", 0, 2147483647),
    });
  }

  // At what speed trials are shown, as the server was told; a stroke lasts a tenth of a second.
  pace(watch, isOneWay) {
    const usual = isOneWay ? "0.1" : "1", select = byId("playback");
    if (!watch) select.value = "full";
    else if (select.value === "full" || isOneWay !== this.wasOneWay) select.value = usual;
    this.wasOneWay = isOneWay;
  }

  // Learn, stop it, or let the policy run: which of them can be pressed now.
  buttons({ mode, run, drives, fits, attempts }, balanceLabel) {
    const learning = mode === "learning", reason = fits[byId("learner").value];
    const learn = byId("learn"), balance = byId("balance");
    show(learn, !learning);
    show(byId("halt"), learning);
    byId("halt").disabled = !drives;
    learn.disabled = !drives || Boolean(reason) || mode !== "ready";
    learn.title = reason ?? "";
    setText(learn, attempts.length && !reason ? `Learn from ${attempts.length}` : "Learn");
    show(balance, Boolean(run?.trials.length) && !learning);
    balance.disabled = !drives || !["ready", "balancing"].includes(mode);
    setText(balance, balanceLabel);
  }

  // What is going on in this very state, at most four times a second, so that it can be read.
  here(now, conditional, action, system) {
    if (now - this.spoken < 250) return;
    this.spoken = now;
    setText(byId("here"), conditional ? sentenceHere(conditional, action, system) : "");
  }
}

function sentenceHere(conditional, action, system) {
  const said = (value) => withUnit(signed(value), system.actions[0]);
  if (conditional.isFar) return `Nobody has been near this state before; it does ${said(action)}.`;
  const epsilon = `(ε ${conditional.epsilon.toFixed(2)})`;
  const off = Math.abs(action - conditional.mean) / (conditional.deviation || 1);
  const usual = said(conditional.mean), does = said(action);
  if (conditional.epsilon < 0.35) {
    return `Here they agree ${epsilon} on ${usual}: ${off < 1 ? `${does} repeats it` : `yet it does ${does}`}.`;
  }
  const how = off < 0.35 ? "near the middle" : off < 1.2 ? "to one side of it" : "well away from it";
  return `Here they disagree ${epsilon}, ${usual} on average: ${does} is ${how}.`;
}
