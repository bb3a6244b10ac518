// What can be done now: the buttons below the stage, and the keys that do the same.

import { byId, h } from "misstep/dom.js";

export const button = (id, text, keys, kind, run) =>
  h("button", { id, className: kind, onclick: run }, text, keys ? h("kbd", {}, keys) : null);

// By mode: id, text, key, kind, and the message that it sends.
const AGAIN = ["restart", "Again", "R", "", { t: "restart" }], STOP = ["stop", "Stop", "Esc", "", { t: "stop" }];
const BUTTONS = {
  ready: [["begin", "Start", "Space", "primary", { t: "begin" }]],
  countdown: [STOP],
  driving: [["fail", "It has failed now", "F", "", { t: "fail" }], ["pause", "Pause", "Space", "", { t: "pause" }], AGAIN, STOP],
  paused: [["resume", "Go on", "Space", "primary", { t: "resume" }], AGAIN, STOP],
  ended: [["keep", "Keep it", "Enter", "primary", { t: "keep" }], ["discard", "Throw it away", "⌫", "", { t: "discard" }], AGAIN],
  learning: [],
  balancing: [
    ["poke-left", "◀ Push", "←", "", { t: "poke", side: -1 }], ["poke-right", "Push ▶", "→", "", { t: "poke", side: 1 }],
    ["rest", "Stop it", "Esc", "", { t: "rest" }]],
};

// By key and mode: the kind of message.
const KEYS = {
  push: { ready: "begin" },
  " ": { ready: "begin", paused: "resume", driving: "pause", countdown: "stop", ended: "keep" },
  Enter: { ready: "begin", paused: "resume", ended: "keep" },
  Backspace: { ended: "discard", paused: "stop" },
  r: { ready: "restart", countdown: "restart", driving: "restart", paused: "restart", ended: "restart" },
  f: { driving: "fail", paused: "fail" },
  Escape: { countdown: "stop", driving: "stop", paused: "stop", balancing: "stop", learning: "stop" },
};

export const meaningOf = (name, mode) => KEYS[name]?.[mode];

export function showActions({ mode, drives, system }, isPlaying, send) {
  const box = byId("actions"), told = `${mode} ${drives} ${system.name} ${isPlaying}`;
  if (box.dataset.told === told) return;
  box.dataset.told = told;
  const wanted = BUTTONS[mode].filter(([id]) => system.pushable || !id.startsWith("poke"));
  // While a recording plays, Space is the player's.
  const keys = (name) => (isPlaying && name === "Space" ? "" : name);
  box.replaceChildren(...(drives ? wanted.map(([id, text, name, kind, message]) => button(id, text, keys(name), kind, () => send(message))) : []));
}
