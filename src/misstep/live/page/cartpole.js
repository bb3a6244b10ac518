// A cart-pole: the rail and its ends, the cart, the pole with the way of its tip, force and hand.

import { arrow, box, font, smallSize, zoom } from "misstep/pen.js";
import { colours, faded } from "misstep/theme.js";

const TRAIL = 0.7; // s of the tip's way that stays in sight
const DEAD_ZONE = 0.16; // of the width, in which the cart moves and the camera does not

export function drawCartPole(stage, pen, width, height, state, view) {
  const p = stage.system.parameters, u = p.half_length;
  const limit = Math.min(p.rail, p.track_limit || Infinity);
  const swings = p.fall_angle_deg > 90;
  const above = swings ? 2.3 * u : 2.42 * u, below = swings ? 2.5 * u : 0.95 * u;
  let scale = Math.min(height / (above + below), width / (3.6 * u));
  const whole = 2 * (limit + 0.75 * u);
  const fits = width / whole > 0.42 * scale;
  if (fits) scale = Math.min(scale, width / whole);
  stage.scale = scale;
  if (fits) stage.camera = 0;
  else follow(stage, state.x, width / scale);
  const slack = height - (above + below) * scale;
  const X = (x) => width / 2 + (x - stage.camera) * scale;
  const hingeY = above * scale + 0.5 * slack;
  const size = smallSize();

  drawGround(stage, pen, width, height, X, hingeY, scale, u, limit, size);
  const fallen = Math.abs(state.theta) > (p.fall_angle_deg * Math.PI) / 180;
  if (!swings) drawWedge(pen, X(state.x), hingeY, 2.05 * u * scale, p.fall_angle_deg, state.theta);
  drawTrail(stage, pen, state, view, X, hingeY, scale, u);
  drawCart(pen, X(state.x), hingeY, scale * u, state.x / (0.09 * u));
  drawPole(pen, X(state.x), hingeY, scale * u, state.theta, fallen);
  if (view.hand !== null && view.hand !== undefined) {
    drawSpring(pen, X(state.x + 2 * u * Math.sin(state.theta)), hingeY - 2 * u * Math.cos(state.theta) * scale,
      X(view.hand), hingeY - 2 * u * Math.cos(state.theta) * scale);
  }
  const share = Math.max(-1, Math.min(1, view.action[0] / p.force_limit));
  if (Math.abs(share) > 0.02) {
    const start = X(state.x) + Math.sign(share) * 0.44 * u * scale;
    const end = start + share * 1.5 * u * scale;
    arrow(pen, start, hingeY, end, hingeY, Math.max(5, 0.075 * u * scale), colours.path);
    pen.fillStyle = colours.path;
    pen.font = font(size, 600);
    pen.textAlign = share > 0 ? "left" : "right";
    pen.textBaseline = "bottom";
    pen.fillText(`${Math.abs(view.action[0]).toFixed(1)} N`, start, hingeY - Math.max(10, 0.14 * u * scale));
  }
}

function follow(stage, x, seen) {
  const free = DEAD_ZONE * seen;
  if (Math.abs(x - stage.camera) > seen) stage.camera = x;
  stage.camera = Math.min(Math.max(stage.camera, x - free), x + free);
}

function drawGround(stage, pen, width, height, X, hingeY, scale, u, limit, size) {
  const top = hingeY + 0.25 * u * scale, thick = Math.max(5, 0.11 * u * scale);
  const half = width / 2 / scale, c = stage.camera;
  const step = scale > 60 ? 0.5 : scale > 24 ? 1 : 2;
  pen.fillStyle = faded(colours.steel, 0.1);
  pen.fillRect(0, top + thick, width, height - top - thick);
  // Lines behind, so that one sees the cart move where the camera goes along.
  pen.strokeStyle = faded(colours.steel, 0.16);
  pen.lineWidth = 1;
  pen.beginPath();
  for (let k = Math.ceil((c - half) / step); k * step <= c + half; k++) {
    const x = Math.round(X(k * step)) + 0.5;
    pen.moveTo(x, 0); pen.lineTo(x, top);
  }
  pen.stroke();
  const edge = Number.isFinite(limit) ? limit + 0.42 * u : Infinity;
  const left = Math.max(X(-Math.min(edge, 1e4)), -40), right = Math.min(X(Math.min(edge, 1e4)), width + 40);
  pen.fillStyle = faded(colours.steel, 0.75);
  box(pen, left, top, right - left, thick, thick / 2);
  pen.fill();
  pen.fillStyle = colours.faint;
  pen.font = font(size);
  pen.textAlign = "center"; pen.textBaseline = "top";
  for (let k = Math.ceil((c - half) / 0.1); k * 0.1 <= c + half; k++) {
    const place = k / 10, major = k % Math.round(step * 10) === 0;
    if (Math.abs(place) > edge || (!major && scale < 90)) continue;
    pen.fillStyle = faded(colours.steel, major ? 0.9 : 0.4);
    pen.fillRect(X(place) - 0.75, top + thick + 3, 1.5, major ? 8 : 4);
    if (major && k % Math.round(step * 20) === 0) {
      pen.fillStyle = colours.faint;
      pen.fillText(`${String(place).replace("-", "−")} m`, X(place), top + thick + 14);
    }
  }
  if (stage.system.parameters.track_limit || stage.system.parameters.rail < 50) {
    for (const side of [-1, 1]) drawStop(pen, X(side * limit), side, top, thick, scale * u);
  }
}

function drawStop(pen, x, side, top, thick, u) {
  pen.fillStyle = faded(colours.bad, 0.13);
  pen.fillRect(side > 0 ? x : x - 4000, top - 0.9 * u, 4000, 0.9 * u + thick);
  pen.strokeStyle = colours.bad;
  pen.lineWidth = 2;
  pen.setLineDash([6, 5]);
  pen.beginPath(); pen.moveTo(x, top - 0.9 * u); pen.lineTo(x, top + thick); pen.stroke();
  pen.setLineDash([]);
}

function drawWedge(pen, x, y, length, degrees, theta) {
  const angle = (degrees * Math.PI) / 180;
  for (const side of [-1, 1]) {
    const near = Math.max(0, Math.min(1, (side * theta) / angle));
    pen.strokeStyle = near > 0.5 ? faded(colours.bad, 0.25 + 0.6 * near) : faded(colours.steel, 0.55);
    pen.lineWidth = (1.5 + near) * zoom();
    pen.setLineDash([5, 6]);
    pen.beginPath();
    pen.moveTo(x + 0.28 * length * Math.sin(side * angle), y - 0.28 * length * Math.cos(angle));
    pen.lineTo(x + length * Math.sin(side * angle), y - length * Math.cos(angle));
    pen.stroke();
  }
  pen.setLineDash([]);
}

function drawTrail(stage, pen, state, view, X, hingeY, scale, u) {
  const trail = stage.trail, last = trail.at(-1);
  if (last && (view.time < last.time || view.time > last.time + 1)) trail.length = 0;
  if (!last || view.time > last.time) trail.push({ time: view.time, x: state.x, theta: state.theta });
  while (trail.length && trail[0].time < view.time - TRAIL) trail.shift();
  pen.lineWidth = Math.max(2, 0.03 * u * scale);
  pen.lineCap = "butt"; // round ends would lie on each other like beads
  for (let i = 1; i < trail.length; i++) {
    pen.strokeStyle = faded(colours.shown, 0.42 * (1 - (view.time - trail[i].time) / TRAIL));
    pen.beginPath();
    for (const point of [trail[i - 1], trail[i]]) {
      const x = X(point.x + 2 * u * Math.sin(point.theta)), y = hingeY - 2 * u * Math.cos(point.theta) * scale;
      if (point === trail[i]) pen.lineTo(x, y); else pen.moveTo(x, y);
    }
    pen.stroke();
  }
  pen.lineCap = "round";
}

function drawCart(pen, x, y, u, turned) {
  const half = 0.38 * u, tall = 0.155 * u, wheel = 0.095 * u;
  for (const side of [-1, 1]) {
    const cx = x + side * 0.22 * u, cy = y + 0.25 * u - wheel;
    pen.fillStyle = colours.cart;
    pen.beginPath(); pen.arc(cx, cy, wheel, 0, 7); pen.fill();
    pen.strokeStyle = colours.card;
    pen.lineWidth = Math.max(1.5, 0.02 * u);
    for (const spoke of [0, Math.PI / 2]) {
      const dx = Math.cos(turned + spoke) * wheel * 0.58, dy = Math.sin(turned + spoke) * wheel * 0.58;
      pen.beginPath(); pen.moveTo(cx - dx, cy - dy); pen.lineTo(cx + dx, cy + dy); pen.stroke();
    }
  }
  pen.fillStyle = colours.cart;
  box(pen, x - half, y - tall, 2 * half, 1.75 * tall, 0.09 * u);
  pen.fill();
  pen.fillStyle = faded(colours.card, 0.14);
  box(pen, x - half, y - tall, 2 * half, 0.55 * tall, 0.09 * u);
  pen.fill();
}

function drawPole(pen, x, y, u, theta, fallen) {
  const tipX = x + 2 * u * Math.sin(theta), tipY = y - 2 * u * Math.cos(theta);
  pen.strokeStyle = fallen ? colours.bad : colours.shown;
  pen.lineWidth = Math.max(5, 0.1 * u);
  pen.beginPath(); pen.moveTo(x, y); pen.lineTo(tipX, tipY); pen.stroke();
  pen.strokeStyle = faded("#ffffff", 0.28);
  pen.lineWidth = Math.max(1.5, 0.028 * u);
  pen.beginPath();
  pen.moveTo(x + 0.16 * u * Math.sin(theta), y - 0.16 * u * Math.cos(theta));
  pen.lineTo(tipX, tipY); pen.stroke();
  pen.fillStyle = colours.card; pen.strokeStyle = colours.cart;
  pen.lineWidth = Math.max(2, 0.035 * u);
  pen.beginPath(); pen.arc(x, y, Math.max(4, 0.075 * u), 0, 7); pen.fill(); pen.stroke();
}

function drawSpring(pen, x0, y0, x1, y1) {
  const turns = 9, amplitude = 6 * zoom();
  pen.strokeStyle = colours.good;
  pen.lineWidth = 2 * zoom();
  pen.beginPath(); pen.moveTo(x0, y0);
  for (let i = 1; i < turns * 2; i++) {
    pen.lineTo(x0 + ((x1 - x0) * i) / (turns * 2), y0 + (y1 - y0) * (i / (turns * 2)) + (i % 2 ? amplitude : -amplitude));
  }
  pen.lineTo(x1, y1); pen.stroke();
  pen.fillStyle = colours.good;
  pen.beginPath(); pen.arc(x1, y1, 8 * zoom(), 0, 7); pen.fill();
}
