// Figures beside what is drawn: time, angle and action; ε; and what the colours mean.

import { byId, h, inShownUnit, nameOf, setText, signed, withUnit } from "misstep/dom.js";

export function showHud(system, view) {
  const box = byId("hud");
  const main = system.columns.find((column) => column.name === system.main) ?? system.columns[0];
  const value = view.observation[system.columns.indexOf(main)], action = system.actions[0];
  const rows = [
    ["time", `${view.time.toFixed(2)} s`],
    [nameOf(main), withUnit(signed(inShownUnit(main, value), main.unit === "rad" ? 1 : 2), main)],
    [nameOf(action), withUnit(signed(view.action[0]), action)]];
  if (box.childElementCount !== 2 * rows.length) box.replaceChildren(...rows.flatMap(() => [h("span"), h("b")]));
  rows.forEach(([name, text], i) => { setText(box.children[2 * i], name); setText(box.children[2 * i + 1], text); });
}

export function showEpsilon(model, conditional) {
  const told = model?.told, value = conditional?.epsilon ?? 0;
  const donut = !told?.own ? "donut" : told.donut ? "donut: where it goes" : "donut, not its way";
  setText(byId("density-legend").children[1], donut);
  setText(byId("epsilon-value"), conditional ? `ε = ${value.toFixed(2)}` : "ε  –");
  byId("epsilon-bar").style.transform = `scaleX(${value.toFixed(3)})`;
}

export function showLegends() {
  const item = (mark, colour, text, title = "") => h("span", { "data-mark": mark, style: `--c: var(--${colour})`, title }, text);
  byId("plane-legend").replaceChildren(
    item("●", "shown", "attempts"), item("■", "path", "trials before"), item("◯", "mix", "mixture, 3 σ"), item("━", "path", "now"));
  byId("density-legend").replaceChildren(
    item("▬", "shown", "usual", "what the attempts did in states like this one"),
    item("━", "mix", "", "the same with a hole where they failed: the more they disagree, the deeper"),
    item("▲", "path", "now", "what is being done in this very moment"));
  byId("costs-legend").replaceChildren(
    item("▮", "shown", "d: attempts"), item("▮", "path", "t: trials"), item("✓", "good", "success"));
  byId("epsilon").replaceChildren(
    h("b", { id: "epsilon-value" }, "ε"), h("div", { className: "gauge" }, h("i", { id: "epsilon-bar" })),
    h("small", {}, h("span", {}, "they agree: repeat"), h("span", {}, "they disagree: avoid")));
}
