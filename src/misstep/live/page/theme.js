// Light and dark, and the colours for what is drawn on canvases.

import { byId } from "misstep/dom.js";

const NAMES = ["card", "ink", "faint", "line", "shown", "path", "good", "mix", "bad", "steel", "cart"];
const dark = matchMedia("(prefers-color-scheme: dark)");
const listeners = [];

export const colours = {};
export const onTheme = (listener) => listeners.push(listener);

function stored() {
  try { return localStorage.getItem("misstep-theme"); } catch { return null; }
}

function applyTheme(choice = stored()) {
  const name = choice ?? (dark.matches ? "dark" : "light");
  document.documentElement.dataset.theme = name;
  const style = getComputedStyle(document.documentElement);
  for (const key of NAMES) colours[key] = style.getPropertyValue(`--${key}`).trim();
  byId("theme").textContent = name === "dark" ? "☀" : "☾";
  for (const listener of listeners) listener();
}

export function startTheme() {
  applyTheme();
  dark.addEventListener("change", () => applyTheme());
  byId("theme").addEventListener("click", () => {
    const next = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
    try { localStorage.setItem("misstep-theme", next); } catch { /* private window: until reload */ }
    applyTheme(next);
  });
}

// A colour with an opacity from 0 to 1.
export function faded(colour, opacity) {
  const n = parseInt(colour.slice(1).replace(/^(.)(.)(.)$/, "$1$1$2$2$3$3"), 16);
  return `rgb(${n >> 16} ${(n >> 8) & 255} ${n & 255} / ${opacity})`;
}
