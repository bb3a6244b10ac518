// What each attempt and each trial cost, or how long it lasted; a click opens it.

import { brief, prepared, ticks, fontSize } from "misstep/dom.js";
import { colours, faded } from "misstep/theme.js";

export class Chart {
  constructor(canvas, open) {
    this.canvas = canvas;
    this.items = [];
    this.stale = true;
    canvas.addEventListener("click", (event) => {
      const near = this.near(event);
      if (near) open(near);
    });
    canvas.addEventListener("pointermove", (event) => {
      canvas.style.cursor = this.near(event) ? "pointer" : "default";
    });
  }

  // items: {label, value, trial, outcome, open}, demonstrations first.
  change(items, title) {
    this.items = items;
    this.title = title;
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
    const { pen, width, height } = ready, size = Math.max(11, 0.74 * fontSize());
    pen.clearRect(0, 0, width, height);
    const left = 3.1 * size, floor = height - 1.7 * size, top = 1.3 * size, right = width - 8;
    const values = this.items.map((item) => item.value).filter((value) => value !== null);
    const most = Math.max(...values, 1e-9) * 1.08;
    const Y = (value) => floor - (value / most) * (floor - top);
    pen.font = `${size}px ${getComputedStyle(document.body).fontFamily}`;
    pen.textBaseline = "middle"; pen.textAlign = "right";
    const marks = ticks(0, most, Math.max(2, (floor - top) / 42));
    for (const value of values.length ? marks.at : []) {
      pen.fillStyle = colours.faint;
      pen.fillText(value.toFixed(marks.digits), left - 6, Y(value));
      pen.strokeStyle = colours.line;
      pen.beginPath(); pen.moveTo(left, Math.round(Y(value)) + 0.5); pen.lineTo(right, Math.round(Y(value)) + 0.5); pen.stroke();
    }
    const n = this.items.length, slot = Math.min((right - left) / Math.max(n, 1), 5.2 * size);
    this.items.forEach((item, i) => this.drawItem(pen, item, left + (i + 0.5) * slot, slot, Y, floor, size, item.open === chosen));
    if (!n) {
      pen.fillStyle = colours.faint; pen.textAlign = "center";
      pen.fillText("each attempt and each trial appears here", width / 2, (top + floor) / 2);
    }
  }

  drawItem(pen, item, x, slot, Y, floor, size, chosen) {
    item.x = x;
    if (chosen) {
      pen.fillStyle = faded(colours.steel, 0.16);
      pen.beginPath(); pen.roundRect(x - 0.46 * slot, 2, 0.92 * slot, floor + 1.6 * size, 6); pen.fill();
    }
    const colour = item.outcome === "success" ? colours.good : item.trial ? colours.path : colours.shown;
    if (item.value !== null) {
      const bar = Math.max(3, Math.min(0.56 * slot, 2.2 * size)), y = Math.min(Y(item.value), floor - 2);
      pen.fillStyle = faded(colour, item.trial ? 0.8 : 0.4);
      pen.beginPath(); pen.roundRect(x - bar / 2, y, bar, floor - y, [4, 4, 0, 0]); pen.fill();
      pen.textAlign = "center"; pen.textBaseline = "bottom";
      pen.fillStyle = colours.ink;
      if (slot > 2.6 * size) pen.fillText(brief(item.value) + (item.outcome === "success" ? " ✓" : ""), x, y - 2);
    }
    pen.textAlign = "center"; pen.textBaseline = "top";
    pen.fillStyle = item.trial ? colours.path : colours.faint;
    if (slot > 2.2 * size || item.number % 5 === 0) pen.fillText(item.label, x, floor + 4);
  }
}
