// Systems of Gymnasium that are known by their columns: a pendulum, poles on a cart, a car on a hill.

import { arrow, box, world, zoom } from "misstep/pen.js";
import { colours, faded } from "misstep/theme.js";

const POLE = 0.6, RAIL = 1; // m, of both systems with a cart
const GOAL = 0.45; // where the flag of the hill is

// The share of the largest action, from −1 to 1.
const shareOf = (stage, view) => view.action[0] / (Math.max(Math.abs(stage.system.low[0]), Math.abs(stage.system.high[0])) || 1);

function drawPole(pen, from, to, thickness) {
  pen.strokeStyle = colours.shown;
  pen.lineWidth = thickness;
  pen.beginPath(); pen.moveTo(...from); pen.lineTo(...to); pen.stroke();
  pen.strokeStyle = faded("#ffffff", 0.28);
  pen.lineWidth = 0.28 * thickness;
  pen.stroke();
}

function drawHinge(pen, [x, y], radius) {
  pen.fillStyle = colours.card; pen.strokeStyle = colours.cart;
  pen.lineWidth = Math.max(2, 0.45 * radius);
  pen.beginPath(); pen.arc(x, y, radius, 0, 7); pen.fill(); pen.stroke();
}

// Angles go to the left, and the torque with them.
export function drawPendulum(stage, pen, width, height, state, view) {
  const { X, Y, scale } = world(pen, width, height, -1.35, 1.35, -1.25, 1.25);
  pen.strokeStyle = faded(colours.steel, 0.35);
  pen.lineWidth = 1.5 * zoom();
  pen.setLineDash([5, 6]);
  pen.beginPath(); pen.arc(X(0), Y(0), scale, 0, 7); pen.stroke();
  pen.setLineDash([]);
  pen.strokeStyle = colours.good;
  pen.lineWidth = 4 * zoom();
  pen.beginPath(); pen.arc(X(0), Y(0), scale * 1.08, -Math.PI / 2 - 0.21, -Math.PI / 2 + 0.21); pen.stroke();
  drawPole(pen, [X(0), Y(0)], [X(-state.sin_theta), Y(state.cos_theta)], 0.11 * scale);
  drawHinge(pen, [X(0), Y(0)], 0.06 * scale);
  const share = shareOf(stage, view);
  if (Math.abs(share) < 0.02) return;
  // An arc around the hinge, counter-clockwise for a positive torque.
  const radius = 0.32 * scale, turn = -share * 2.2, end = -Math.PI / 2 + turn, sign = Math.sign(turn);
  pen.strokeStyle = colours.path;
  pen.lineWidth = 0.045 * scale;
  pen.beginPath(); pen.arc(X(0), Y(0), radius, -Math.PI / 2, end, turn < 0); pen.stroke();
  const tip = [X(0) + radius * Math.cos(end), Y(0) + radius * Math.sin(end)], along = [-sign * Math.sin(end), sign * Math.cos(end)];
  arrow(pen, tip[0], tip[1], tip[0] + 0.12 * scale * along[0], tip[1] + 0.12 * scale * along[1], 0.045 * scale, colours.path);
}

export function drawCartWithPoles(stage, pen, width, height, state, view) {
  const poles = state.cos_theta_2 === undefined ? 1 : 2;
  const angles = poles === 1 ? [state.theta] : [Math.atan2(state.sin_theta_1, state.cos_theta_1)];
  if (poles === 2) angles.push(angles[0] + Math.atan2(state.sin_theta_2, state.cos_theta_2));
  const { X, Y, scale } = world(pen, width, height, -RAIL - 0.25, RAIL + 0.25, -0.4, poles * POLE + 0.25);
  const top = Y(-0.12);
  pen.fillStyle = faded(colours.steel, 0.1);
  pen.fillRect(0, top, width, height - top);
  pen.fillStyle = faded(colours.steel, 0.75);
  box(pen, X(-RAIL - 0.12), top, 2 * (RAIL + 0.12) * scale, 0.045 * scale, 4); pen.fill();
  pen.strokeStyle = colours.bad;
  pen.lineWidth = 2 * zoom();
  pen.setLineDash([6, 5]);
  for (const end of [-RAIL, RAIL]) { pen.beginPath(); pen.moveTo(X(end), Y(0.25)); pen.lineTo(X(end), top); pen.stroke(); }
  // Where the tip is to stay above.
  if (poles === 2) {
    pen.strokeStyle = faded(colours.steel, 0.6);
    pen.beginPath(); pen.moveTo(0, Y(1)); pen.lineTo(width, Y(1)); pen.stroke();
  }
  pen.setLineDash([]);
  pen.fillStyle = colours.cart;
  box(pen, X(state.x - 0.13), Y(0.06), 0.26 * scale, 0.18 * scale, 0.04 * scale); pen.fill();
  let at = [X(state.x), Y(0)];
  for (const angle of angles) {
    const next = [at[0] + POLE * scale * Math.sin(angle), at[1] - POLE * scale * Math.cos(angle)];
    drawPole(pen, at, next, 0.055 * scale);
    drawHinge(pen, at, 0.03 * scale);
    at = next;
  }
  const share = shareOf(stage, view), start = X(state.x) + Math.sign(share) * 0.16 * scale;
  if (Math.abs(share) > 0.02) arrow(pen, start, Y(-0.03), start + share * 0.4 * scale, Y(-0.03), 0.045 * scale, colours.path);
}

const heightAt = (x) => 0.45 * Math.sin(3 * x) + 0.55;

export function drawHill(stage, pen, width, height, state, view) {
  const { X, Y, scale } = world(pen, width, height, -1.25, 0.65, -0.05, 1.3), x = state.position;
  pen.beginPath();
  pen.moveTo(X(-1.2), Y(heightAt(-1.2)));
  for (let k = -1.2; k <= 0.6; k += 0.02) pen.lineTo(X(k), Y(heightAt(k)));
  pen.strokeStyle = faded(colours.steel, 0.9); pen.lineWidth = 0.02 * scale;
  pen.stroke();
  pen.lineTo(X(0.6), height); pen.lineTo(X(-1.2), height); pen.closePath();
  pen.fillStyle = faded(colours.steel, 0.12);
  pen.fill();
  pen.strokeStyle = pen.fillStyle = colours.good;
  pen.lineWidth = 2.5 * zoom();
  pen.beginPath(); pen.moveTo(X(GOAL), Y(heightAt(GOAL))); pen.lineTo(X(GOAL), Y(heightAt(GOAL) + 0.22)); pen.stroke();
  pen.beginPath(); pen.moveTo(X(GOAL), Y(heightAt(GOAL) + 0.22)); pen.lineTo(X(GOAL + 0.09), Y(heightAt(GOAL) + 0.185)); pen.lineTo(X(GOAL), Y(heightAt(GOAL) + 0.15)); pen.fill();
  const slope = Math.atan(1.35 * Math.cos(3 * x)), share = shareOf(stage, view);
  pen.save();
  pen.translate(X(x), Y(heightAt(x)));
  pen.rotate(-slope);
  pen.fillStyle = colours.shown;
  box(pen, -0.085 * scale, -0.1 * scale, 0.17 * scale, 0.065 * scale, 0.02 * scale); pen.fill();
  pen.fillStyle = colours.cart;
  for (const side of [-1, 1]) { pen.beginPath(); pen.arc(side * 0.05 * scale, -0.035 * scale, 0.03 * scale, 0, 7); pen.fill(); }
  const start = Math.sign(share) * 0.1 * scale;
  if (Math.abs(share) > 0.02) arrow(pen, start, -0.07 * scale, start + share * 0.22 * scale, -0.07 * scale, 0.025 * scale, colours.path);
  pen.restore();
}
