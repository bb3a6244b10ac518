// What is being looked at: an attempt or a trial in the player, or nothing but what is going on.

import { Model } from "misstep/model.js";

export class Viewer {
  // page: {state, library, player, stage, send, refresh}; the player's `ended` is to call `watched`.
  constructor(page) {
    Object.assign(this, page);
    this.attempt = null; // id of the attempt that is open
    this.trial = null; // number of the trial that is open
    this.model = null;
    this.following = false; // whether each trial is opened as it comes
  }

  get isOpen() { return this.attempt !== null || this.trial !== null; }

  get canOpen() { return !["countdown", "driving", "balancing"].includes(this.state.session.mode); }

  // The name of what is open, as the chart knows it.
  get name() {
    if (this.trial !== null) return `trial ${this.trial}`;
    return this.attempt !== null ? `attempt ${this.attempt}` : null;
  }

  openAttempt(id, keepPlace = false) {
    const recording = this.library.recordings.get(id);
    if (!recording || !this.canOpen) return;
    this.following = false;
    const place = this.player.position;
    [this.attempt, this.trial, this.model] = [id, null, this.state.demoModel];
    this.player.open(recording, !keepPlace);
    if (keepPlace) this.player.position = Math.min(place, this.player.duration);
    this.refresh();
  }

  openTrial(number) {
    const trial = this.library.trials.get(number);
    if (!trial || !this.canOpen) return;
    [this.attempt, this.trial] = [null, number];
    this.model = trial.model ? new Model(trial.model, this.state.session.system.columns) : null;
    this.stage.reset();
    this.player.open(trial);
    this.refresh();
  }

  close() {
    this.following = this.following && this.state.session?.mode === "learning";
    this.player.close();
    this.attempt = this.trial = this.model = null;
    this.stage.reset();
    if (this.state.session) this.refresh();
  }

  // A trial has come: it is opened if one is watching them, and is not looking at another.
  trialCame(number) {
    const { session } = this.state;
    if (this.following && number === session.run?.trials.length) this.openTrial(number);
  }

  // What is open has been played to its end: while it learns, the next trial may be made or is next.
  watched() {
    const { session } = this.state;
    if (session.mode === "learning" && this.trial !== null) {
      if (this.trial < session.run.trials.length) { this.openTrial(this.trial + 1); return; }
      this.following = true;
      this.tellWatched();
    }
    this.refresh();
  }

  tellWatched() {
    if (this.state.session.drives && this.player.told && this.trial !== null) this.send({ t: "next", trial: this.trial });
  }
}
