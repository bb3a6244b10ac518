// Hands: keys, touch pads and a gamepad become how far each action is pushed, from −1 to 1.

import { byId } from "misstep/dom.js";

const KEYS = { ArrowLeft: [0, -1], a: [0, -1], ArrowRight: [0, 1], d: [0, 1], ArrowDown: [1, -1], s: [1, -1], ArrowUp: [1, 1], w: [1, 1] };
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
    this.padsBefore = {};
    addEventListener("keydown", (event) => this.keyDown(event));
    addEventListener("keyup", (event) => { if (this.down.delete(key(event))) this.send(event.timeStamp); });
    addEventListener("blur", () => this.release());
    for (const [id, name] of [["pad-left", "ArrowLeft"], ["pad-right", "ArrowRight"]]) this.pad(byId(id), name);
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
    const pad = navigator.getGamepads?.().find((one) => one?.connected);
    if (!pad) return;
    const stick = pad.axes.slice(0, this.size).map((value) => (Math.abs(value) < 0.12 ? 0 : value));
    if (pad.buttons[14]?.pressed) stick[0] = -1;
    if (pad.buttons[15]?.pressed) stick[0] = 1;
    this.stick = stick.some((value) => value) ? stick : null;
    for (const [index, name] of Object.entries(PAD_BUTTONS)) {
      const isDown = Boolean(pad.buttons[index]?.pressed);
      if (isDown && !this.padsBefore[index]) this.pressed(name);
      this.padsBefore[index] = isDown;
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
    this.stick?.forEach((value, i) => { result[i] += value; });
    return result.map((value) => Math.round(Math.max(-1, Math.min(1, value)) * 100) / 100);
  }

  send(when) {
    const values = this.values(), text = values.join();
    if (text === this.last) return;
    this.last = text;
    this.moved(values, when);
  }
}
