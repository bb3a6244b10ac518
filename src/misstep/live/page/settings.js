// The sliders: strength, speed, the angle at which an attempt starts, and the countdown.

import { byId, setText, show, signed } from "misstep/dom.js";

const SPEEDS = [0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.7, 1, 1.5];
const BY_CHANCE = -31; // deg: the place on the slider of an angle that the system chooses
const IDS = ["strength", "speed", "angle", "countdown"];

export function startSettings(send) {
  const told = () => {
    const angle = Number(byId("angle").value);
    send({
      t: "settings", strength: Number(byId("strength").value) / 100, speed: SPEEDS[Number(byId("speed").value)],
      start_angle: angle <= BY_CHANCE ? null : angle, countdown: Number(byId("countdown").value),
    });
  };
  for (const id of IDS) {
    byId(id).addEventListener("input", told);
    // Let go with the mouse, the arrow keys are to drive again; with the keyboard, to go on setting.
    byId(id).addEventListener("pointerup", (event) => event.target.blur());
  }
}

export function showSettings({ settings, drives, system }) {
  const nearest = (best, one, i) => (Math.abs(one - settings.speed) < Math.abs(SPEEDS[best] - settings.speed) ? i : best);
  const set = (id, value, text) => {
    const range = byId(id);
    if (document.activeElement !== range && range.value !== String(value)) range.value = value;
    range.disabled = !drives;
    range.setAttribute("aria-valuetext", text);
    setText(byId(`${id}-out`), text);
  };
  show(byId("angle-label"), system.can_start_at);
  set("strength", Math.round(100 * settings.strength), `${Math.round(100 * settings.strength)} %`);
  set("speed", SPEEDS.reduce(nearest, 0), settings.speed === 1 ? "real time" : `${settings.speed} ×`);
  set("angle", settings.start_angle ?? BY_CHANCE, settings.start_angle === null ? "by chance" : `${signed(settings.start_angle, 0)}°`);
  set("countdown", settings.countdown, settings.countdown ? `${settings.countdown}` : "none");
}
