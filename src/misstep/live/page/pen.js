// What all drawings of systems need: arrows, rounded boxes, a world on the screen, type.

import { fontSize } from "misstep/dom.js";

export function arrow(pen, x0, y0, x1, y1, thickness, colour) {
  const length = Math.hypot(x1 - x0, y1 - y0);
  if (length < 3) return;
  const head = Math.min(length, 3.1 * thickness), ux = (x1 - x0) / length, uy = (y1 - y0) / length;
  pen.strokeStyle = pen.fillStyle = colour;
  pen.lineWidth = thickness;
  pen.lineCap = "butt";
  if (length > head) {
    pen.beginPath(); pen.moveTo(x0, y0); pen.lineTo(x1 - ux * head * 0.9, y1 - uy * head * 0.9); pen.stroke();
  }
  pen.beginPath();
  pen.moveTo(x1, y1);
  pen.lineTo(x1 - ux * head - uy * head * 0.62, y1 - uy * head + ux * head * 0.62);
  pen.lineTo(x1 - ux * head + uy * head * 0.62, y1 - uy * head - ux * head * 0.62);
  pen.closePath(); pen.fill();
  pen.lineCap = "round";
}

export function box(pen, x, y, w, t, radius) {
  pen.beginPath();
  pen.roundRect(x, y, w, t, radius);
}

let family = "";
// The font of small figures in a drawing, and its size in CSS pixels.
export const smallSize = () => Math.max(11, 0.74 * fontSize());
export const font = (size, weight = "") => `${weight} ${size}px ${(family ||= getComputedStyle(document.body).fontFamily)}`.trim();

// Thickness of thin lines, that of a page whose type is 15 px.
export const zoom = () => fontSize() / 15;

// A part of the world, m, in the middle of the screen as large as it fits.
export function world(pen, width, height, left, right, low, high) {
  const scale = Math.min(width / (right - left), height / (high - low));
  const X = (x) => width / 2 + (x - (left + right) / 2) * scale;
  const Y = (z) => height / 2 - (z - (low + high) / 2) * scale;
  return { scale, X, Y };
}
