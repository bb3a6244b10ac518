// Menus and the help: what can be downloaded, and which keys there are.

import { byId, h } from "misstep/dom.js";

const KEYS = [
  ["← →  or  A D", "push, for as long as the key is down (↑ ↓ or W S: a second action)"],
  ["Space", "start; pause and go on; play and pause a recording"],
  ["R", "start again; what was running is thrown away"],
  ["Enter", "keep the attempt that has ended"],
  ["Backspace", "throw it away"],
  ["F", "it has failed now: ends the attempt at this moment"],
  ["Esc", "stop whatever is going on"],
  ["Ctrl + Z", "take back the last throwing away, deletion or mark"],
  [",  and  .", "one step back and on in a recording"],
  ["Tab", "goes to everything else; in the chart, ← → choose and Enter opens"],
  ["Page up / down", "the trial before and after"],
];

export function startHelp() {
  const dialog = byId("help-dialog");
  dialog.append(
    h("h2", {}, "Fail by hand, and watch it learn"),
    h("p", {}, "Drive the system and fail, four times or so, each time a little differently. Keep the attempts and press Learn: misstep explores away from what you did where you disagreed with yourself, keeps what was good, and tries until a trial succeeds. Then push the pole and see it recover."),
    h("dl", {}, ...KEYS.flatMap(([keys, does]) => [
      h("dt", {}, ...keys.split("  ").filter(Boolean).map((part) => (/^(or|and)$/.test(part) ? ` ${part} ` : h("kbd", {}, part)))),
      h("dd", {}, does),
    ])),
    h("p", { className: "faint" }, "Too hard? Slow it down under “Speed”: the physics stays the same, only time goes by more slowly. A gamepad works, too: stick to push, A start and keep, B throw away, X again, Y failed, Menu stop."),
    h("form", { method: "dialog" }, h("button", { className: "primary" }, "Close")));
  byId("help").addEventListener("click", () => dialog.showModal());
  for (const menu of document.querySelectorAll("details.menu")) {
    document.addEventListener("click", (event) => { if (!menu.contains(event.target)) menu.open = false; });
    menu.addEventListener("keydown", (event) => {
      if (event.key === "Escape") { menu.open = false; menu.querySelector("summary").focus(); event.stopPropagation(); }
    });
  }
}

export function fillSaveMenu(formats, page) {
  const save = (address) => () => { byId("save-menu").open = false; page.fetchFile(address()); };
  const select = h("select", { id: "format" }, ...formats.map((one) =>
    h("option", { value: one.name }, `${one.name} (${one.suffix})`)));
  byId("save-sheet").replaceChildren(
    h("h3", {}, "The whole session, to look at"),
    h("button", { id: "save-replay", onclick: save(() => "./api/replay") }, "Replay in one HTML file"),
    h("h3", {}, "The run, for every misstep command"),
    h("button", { id: "save-run", onclick: () => page.saveRun() }, "Run folder (.zip)"),
    h("h3", {}, "Your attempts"),
    h("div", { className: "row" }, select,
      h("button", { id: "save-attempts", onclick: save(() => `./api/download/${select.value}`) }, "Download")));
}
