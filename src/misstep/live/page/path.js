// The live state between two messages, and the way that it has taken.

const LONGEST = 4000; // states

// States come 50 times a second and frames 60 times: in between, a cart goes on as it moves.
export function liveView({ session, live, liveAt }, now) {
  const { system, settings, mode } = session, observation = live.o.map((value) => value ?? 0);
  if (system.drawing === "cartpole" && ["driving", "balancing"].includes(mode)) {
    const rate = mode === "driving" ? settings.speed : 1;
    const ahead = Math.min(((now - liveAt) / 1000) * rate, 1.2 * system.dt);
    observation[0] += ahead * observation[1];
    observation[2] += ahead * observation[3];
  }
  return { observation, action: live.a, time: live.k * system.dt, step: live.k, hand: live.hold };
}

export class LivePath {
  constructor() { this.clear(); }

  clear() {
    this.observations = [];
    this.actions = [];
    this.step = -1;
  }

  extend({ session, live }) {
    const { step } = this;
    if (live.k < step || session.mode === "ready") this.clear();
    if (live.k <= step || session.mode === "ready") return;
    this.step = live.k;
    this.observations.push(live.o);
    this.actions.push(live.a);
    if (this.actions.length > LONGEST) { this.observations.shift(); this.actions.shift(); }
  }
}
