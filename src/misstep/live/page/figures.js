// How fast it is: the way of a key to the screen, frames a second, ticks that came late.

import { byId, setText } from "misstep/dom.js";

const MEASURED = 600; // latencies and frames that the figures below the page are about
const EVERY = 700; // ms

const quantile = (values, q) => [...values].sort((a, b) => a - b)[Math.min(values.length - 1, Math.floor(q * values.length))];

function keepLast(values, value) {
  values.push(value);
  if (values.length > MEASURED) values.shift();
}

export class Figures {
  constructor() {
    this.latencies = []; // ms
    this.frames = []; // ms from one to the next
    this.pressed = null; // the last push that was told: {number, when}
    this.waiting = null; // when the key was pressed whose effect the next frame shows
    this.lastFrame = 0;
    this.lastShown = 0;
  }

  pushed(number, when) { this.pressed = { number, when }; }

  // A state has come that was computed with the push of that number.
  acknowledged(number) {
    if (this.pressed?.number !== number) return;
    this.waiting = this.pressed.when;
    this.pressed = null;
  }

  // A frame begins; return how long the one before took, s.
  frame(now) {
    const took = this.lastFrame ? now - this.lastFrame : 0;
    if (took) keepLast(this.frames, took);
    this.lastFrame = now;
    return Math.min(took / 1000, 0.1);
  }

  // A frame has been drawn.
  drawn() {
    if (this.waiting === null) return;
    keepLast(this.latencies, performance.now() - this.waiting);
    this.waiting = null;
  }

  show(now, live, link) {
    if (now - this.lastShown < EVERY) return;
    this.lastShown = now;
    const { latencies, frames } = this;
    if (frames.length > 20) setText(byId("fps"), `${Math.round(1000 / quantile(frames, 0.5))} frames/s`);
    if (!link) return;
    setText(byId("latency"), latencies.length ? `key to screen ${quantile(latencies, 0.5).toFixed(0)} ms (95 %: ${quantile(latencies, 0.95).toFixed(0)} ms)` : "");
    setText(byId("late"), live.ticks ? `${live.late} of ${live.ticks} ticks late` : "");
    setText(byId("link-state"), link.isOpen ? "● connected" : "○ not connected");
  }
}
