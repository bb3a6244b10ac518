// What each attempt and each trial cost, or how long it lasted; one that is chosen is opened.

import { brief, prepared, signed, ticks } from "misstep/dom.js";
import { font, smallSize } from "misstep/pen.js";
import { colours, faded } from "misstep/theme.js";

export class Chart {
  constructor(canvas, open) {
    this.canvas = canvas;
    this.items = [];
    this.stale = true;
    this.focused = -1; // which one the keys have chosen
    canvas.addEventListener("click", (event) => {
      const near = this.near(event);
      if (near) open(near);
    });
    canvas.addEventListener("pointermove", (event) => {
      canvas.style.cursor = this.near(event) ? "pointer" : "default";
    });
    canvas.addEventListener("keydown", (event) => this.keyDown(event, open));
    for (const kind of ["focus", "blur"]) canvas.addEventListener(kind, () => { this.stale = true; });
  }

  keyDown(event, open) {
    const { length } = this.items, move = { ArrowLeft: -1, ArrowRight: 1, Home: -length, End: length }[event.key];
    const opens = event.key === "Enter" && this.items[this.focused];
    if (!length || (move === undefined && !opens)) return;
    event.preventDefault();
    event.stopPropagation(); // here, arrows do not drive
    if (opens) { open(opens); return; }
    const from = this.focused < 0 ? (move > 0 ? -1 : length) : this.focused;
    this.focused = Math.max(0, Math.min(length - 1, from + move));
    this.stale = true;
    const { kind, number, value, outcome } = this.items[this.focused];
    this.canvas.setAttribute("aria-label", `${kind} ${number}: ${brief(value)}, ${outcome}; Enter opens it`);
  }

  // items: {label, kind, number, value, trial, outcome, open, openIt}, demonstrations first.
  change(items) {
    this.items = items;
    this.focused = Math.min(this.focused, items.length - 1);
    this.stale = true;
  }

  near(event) {
    const box = this.canvas.getBoundingClientRect();
    const x = event.clientX - box.left;
    const best = this.items.filter((item) => item.x !== undefined).sort((a, b) => Math.abs(a.x - x) - Math.abs(b.x - x))[0];
    return best && Math.abs(best.x - x) < 24 ? best : null;
  }

  draw(chosen) {
    const ready = prepared(this.canvas);
    if (!ready || (!this.stale && !ready.resized && this.chosen === chosen)) return;
    this.stale = false;
    this.chosen = chosen;
    const { pen, width, height } = ready, size = smallSize();
    pen.clearRect(0, 0, width, height);
    pen.font = font(size);
    const floor = height - 1.7 * size, top = 1.5 * size, right = width - 8, n = this.items.length;
    if (!n) {
      pen.fillStyle = colours.faint; pen.textAlign = "center"; pen.textBaseline = "middle";
      pen.fillText("each attempt and each trial appears here", width / 2, (top + floor) / 2);
      return;
    }
    const values = this.items.map((item) => item.value).filter((value) => value !== null);
    const high = Math.max(0, ...values), low = Math.min(0, ...values), span = high - low || 1;
    const below = low < 0 ? floor - 1.3 * size : floor; // room for the figures of what is negative
    const Y = (value) => below - ((value - low) / span) * (below - top);
    const left = this.drawAxis(pen, low, high, Y, size, right, (below - top) / 36);
    this.drawBest(pen, Y, left, right);
    const slot = Math.min((right - left) / n, 5.2 * size);
    this.items.forEach((item, i) => {
      const mark = i === this.focused && document.activeElement === this.canvas;
      this.drawItem(pen, item, { x: left + (i + 0.5) * slot, slot, Y, floor, size, chosen: item.open === chosen, mark });
    });
  }

  drawAxis(pen, low, high, Y, size, right, room) {
    const marks = high > low ? ticks(low, high, Math.max(2, room)) : { at: [0], digits: 0 };
    const texts = marks.at.map((value) => signed(value, marks.digits).replace("+", ""));
    const left = Math.max(2.4 * size, 10 + Math.max(...texts.map((text) => pen.measureText(text).width)));
    pen.textBaseline = "middle"; pen.textAlign = "right";
    pen.fillStyle = colours.faint;
    pen.lineWidth = 1;
    marks.at.forEach((value, i) => {
      const y = Math.round(Y(value)) + 0.5;
      pen.fillText(texts[i], left - 6, y);
      pen.strokeStyle = value === 0 ? faded(colours.steel, 0.7) : colours.line;
      pen.beginPath(); pen.moveTo(left, y); pen.lineTo(right, y); pen.stroke();
    });
    return left;
  }

  // A line at the least that an attempt cost, to which trials are compared.
  drawBest(pen, Y, left, right) {
    const shown = this.items.filter((item) => !item.trial && item.value !== null).map((item) => item.value);
    if (!shown.length || shown.length === this.items.length) return;
    const y = Math.round(Y(Math.min(...shown))) + 0.5;
    pen.strokeStyle = faded(colours.shown, 0.8);
    pen.setLineDash([5, 5]);
    pen.beginPath(); pen.moveTo(left, y); pen.lineTo(right, y); pen.stroke();
    pen.setLineDash([]);
  }

  drawItem(pen, item, { x, slot, Y, floor, size, chosen, mark }) {
    item.x = x;
    if (chosen || mark) {
      pen.beginPath(); pen.roundRect(x - 0.46 * slot, 2, 0.92 * slot, floor + 1.6 * size, 6);
      pen.fillStyle = faded(colours.steel, chosen ? 0.16 : 0.06);
      pen.fill();
      if (mark) { pen.strokeStyle = colours.shown; pen.lineWidth = 2; pen.stroke(); }
    }
    const colour = item.outcome === "success" ? colours.good : item.trial ? colours.path : colours.shown;
    if (item.value !== null) {
      const bar = Math.max(3, Math.min(0.56 * slot, 2.2 * size)), up = item.value >= 0;
      const end = up ? Math.min(Y(item.value), Y(0) - 2) : Math.max(Y(item.value), Y(0) + 2);
      pen.fillStyle = faded(colour, item.trial ? 0.8 : 0.4);
      pen.beginPath(); pen.roundRect(x - bar / 2, Math.min(end, Y(0)), bar, Math.abs(end - Y(0)), up ? [4, 4, 0, 0] : [0, 0, 4, 4]); pen.fill();
      pen.textAlign = "center"; pen.textBaseline = up ? "bottom" : "top";
      pen.fillStyle = colours.ink;
      pen.strokeStyle = colours.card; pen.lineWidth = 0.35 * size; // no line runs through a figure
      const text = brief(item.value) + (item.outcome === "success" ? " ✓" : ""), y = up ? end - 2 : end + 3;
      if (slot > 2.6 * size) { pen.strokeText(text, x, y); pen.fillText(text, x, y); }
    }
    pen.textAlign = "center"; pen.textBaseline = "top";
    pen.fillStyle = item.trial ? colours.path : colours.faint;
    if (slot > 2.2 * size || item.number % 5 === 0) pen.fillText(item.label, x, floor + 4);
  }
}
