// Hands: keys, touch pads and a gamepad become how far each action is pushed, from −1 to 1.

import { byId, show } from "misstep/dom.js";

const KEYS = { ArrowLeft: [0, -1], a: [0, -1], ArrowRight: [0, 1], d: [0, 1], ArrowDown: [1, -1], s: [1, -1], ArrowUp: [1, 1], w: [1, 1] };
// Of a gamepad in the standard layout.
const PAD_CROSS = { 12: [1, 1], 13: [1, -1], 14: [0, -1], 15: [0, 1] };
const DEAD = 0.12; // of a stick that nobody touches
const PAD_BUTTONS = { 0: "Enter", 1: "Backspace", 2: "r", 3: "f", 9: "Escape" };

const key = (event) => (event.key.length === 1 ? event.key.toLowerCase() : event.key);

export class Input {
  // moved(values, when): a push has changed. pressed(key): any other key that means something.
  constructor(moved, pressed) {
    this.moved = moved;
    this.pressed = pressed;
    this.down = new Set();
    this.size = 1;
    this.oneWay = false;
    this.last = "";
    this.stick = [];
    this.padsBefore = {};
    addEventListener("keydown", (event) => this.keyDown(event));
    addEventListener("keyup", (event) => { if (this.down.delete(key(event))) this.send(event.timeStamp); });
    addEventListener("blur", () => this.release());
    const pads = { "pad-left": "ArrowLeft", "pad-right": "ArrowRight", "pad-up": "ArrowUp", "pad-down": "ArrowDown" };
    for (const [id, name] of Object.entries(pads)) this.pad(byId(id), name);
  }

  use(system) {
    this.size = system.actions.length;
    this.oneWay = system.one_way;
    show(byId("pad-left"), !this.oneWay);
    for (const id of ["pad-up", "pad-down"]) show(byId(id), this.size > 1);
  }

  keyDown(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open]")) return;
    const name = key(event), target = event.target;
    const typing = target.closest?.("input, select, textarea, .sheet");
    if (KEYS[name] && !typing) {
      event.preventDefault();
      if (event.repeat || this.down.has(name)) return;
      this.down.add(name);
      this.pressed("push");
      this.send(event.timeStamp);
      return;
    }
    const onControl = typing || target.closest?.("button, summary, a");
    if (onControl && (name === "Enter" || name === " " || typing)) return;
    if (!event.repeat && this.pressed(name)) event.preventDefault();
  }

  pad(button, name) {
    const set = (event, isDown) => {
      event.preventDefault();
      button.classList.toggle("down", isDown);
      if (isDown) { this.down.add(name); this.pressed("push"); } else this.down.delete(name);
      this.send(event.timeStamp);
    };
    button.addEventListener("pointerdown", (event) => { button.setPointerCapture(event.pointerId); set(event, true); });
    for (const kind of ["pointerup", "pointercancel", "lostpointercapture"]) button.addEventListener(kind, (event) => set(event, false));
    button.addEventListener("contextmenu", (event) => event.preventDefault());
  }

  release() {
    this.down.clear();
    this.send(performance.now());
  }

  // Look at the gamepads; to be called once a frame.
  poll(now) {
    const pad = [...(navigator.getGamepads?.() ?? [])].find((one) => one?.connected);
    const isDown = (index) => Boolean(pad?.buttons[index]?.pressed);
    // Axes go to the right and down, actions to the right and up.
    const stick = (pad?.axes ?? []).slice(0, Math.min(this.size, 4)).map((value, i) => (Math.abs(value) < DEAD ? 0 : i % 2 ? -value : value));
    for (const [index, [action, sign]] of Object.entries(PAD_CROSS)) if (isDown(index) && action < this.size) stick[action] = sign;
    this.stick = stick;
    for (const [index, name] of Object.entries(PAD_BUTTONS)) {
      if (isDown(index) && !this.padsBefore[index] && !document.querySelector("dialog[open]")) this.pressed(name);
      this.padsBefore[index] = isDown(index);
    }
    this.send(now);
  }

  values() {
    const result = Array(this.size).fill(0);
    for (const name of this.down) {
      const [index, sign] = KEYS[name];
      if (index < this.size) result[index] += sign;
      else if (this.oneWay) result[0] += sign;
    }
    this.stick.forEach((value, i) => { result[i] += value; });
    return result.map((value) => Math.round(Math.max(-1, Math.min(1, value)) * 100) / 100);
  }

  send(when) {
    const values = this.values(), text = values.join();
    if (text === this.last) return;
    this.last = text;
    this.moved(values, when);
  }
}
