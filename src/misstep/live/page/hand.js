// The mouse, or a finger, at the pole while the policy balances it; told once a frame.

export class Hand {
  // page: {state, stage, send, touched(): called when it takes hold}
  constructor(canvas, page) {
    Object.assign(this, page);
    this.at = null; // where on the screen
    this.told = null; // where on the rail
    canvas.addEventListener("pointerdown", (event) => this.take(event, canvas));
    canvas.addEventListener("pointermove", (event) => { if (this.at !== null) this.at = event.clientX; });
    for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, () => { this.at = null; });
  }

  take(event, canvas) {
    const { session } = this.state;
    if (session?.mode !== "balancing" || !session.drives || !session.system.pushable) return;
    this.at = event.clientX;
    canvas.setPointerCapture(event.pointerId);
    this.touched();
  }

  tell() {
    if (this.state.session.mode !== "balancing") this.at = null;
    const x = this.at === null ? null : this.stage.placeAt(this.at);
    if (x === this.told) return;
    this.told = x;
    this.send({ t: "push", x });
  }
}
