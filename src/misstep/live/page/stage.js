// What a state looks like: the canvas, the camera that goes along, and which drawing it is.

import { drawCartPole } from "misstep/cartpole.js";
import { drawColumns } from "misstep/columns.js";
import { prepared } from "misstep/dom.js";
import { drawCartWithPoles, drawHill, drawPendulum } from "misstep/gymnasium.js";
import { drawBasket, drawFlipUp } from "misstep/striking.js";

const DRAWINGS = {
  cartpole: drawCartPole, flipup: drawFlipUp, basket: drawBasket,
  pendulum: drawPendulum, "cart-with-poles": drawCartWithPoles, hill: drawHill,
};

export class Stage {
  constructor(canvas) {
    this.canvas = canvas;
    this.reset();
  }

  use(system) {
    this.system = system;
    this.range = null; // of the columns, for those that are drawn as bars
    this.scale = null; // px for a metre
    this.names = system.columns.map((column) => column.name);
    this.reset();
  }

  reset() {
    this.trail = [];
    this.camera = 0; // m
  }

  // Where on the rail a place on the screen is, in m; null where that has no meaning.
  placeAt(clientX) {
    if (!this.scale) return null;
    const box = this.canvas.getBoundingClientRect();
    return this.camera + (clientX - box.left - box.width / 2) / this.scale;
  }

  draw(view) {
    const ready = prepared(this.canvas);
    if (!ready || !this.system) return;
    const { pen, width, height } = ready;
    pen.clearRect(0, 0, width, height);
    const state = Object.fromEntries(this.names.map((name, i) => [name, view.observation[i]]));
    pen.lineJoin = pen.lineCap = "round";
    (DRAWINGS[this.system.drawing] ?? drawColumns)(this, pen, width, height, state, view);
  }
}
