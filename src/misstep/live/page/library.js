// Recordings and trials as a whole: what the server has told of in one line is fetched here.

import { getJson } from "misstep/link.js";

export class Library {
  // arrived(kind, number): an "attempt", a "trial" or the "demonstrations" of a run are here now.
  constructor(arrived) {
    this.arrived = arrived;
    this.clear();
  }

  clear() {
    this.recordings = new Map(); // attempts by id
    this.versions = new Map(); // what was told of each when it was fetched
    this.clearRun();
  }

  clearRun() {
    this.trials = new Map(); // by number
    this.demonstrations = null; // of a run that started from others than the attempts
  }

  // The recordings that the present run, or the next one, starts from.
  shown(session) {
    return session.run?.own_demonstrations ? this.demonstrations ?? [] : [...this.recordings.values()];
  }

  // Fetch what is missing, one after the other; told again meanwhile, it goes on with the newest.
  async fetchMissing(session) {
    this.session = session;
    const ids = new Set(session.attempts.map((attempt) => attempt.id));
    for (const id of this.recordings.keys()) if (!ids.has(id)) { this.recordings.delete(id); this.versions.delete(id); }
    if (this.fetching) return;
    this.fetching = true;
    while (await this.fetchOne());
    this.fetching = false;
  }

  async fetchOne() {
    const { attempts, run, system } = this.session;
    const attempt = attempts.find((one) => this.versions.get(one.id) !== JSON.stringify(one));
    if (attempt) {
      const keep = (recording) => {
        this.recordings.set(attempt.id, recording);
        this.versions.set(attempt.id, JSON.stringify(attempt));
        this.arrived("attempt", attempt.id);
      };
      return this.take(`./api/attempt/${attempt.id}`, (now) => now.system.name === system.name && now.attempts.some((one) => one.id === attempt.id), keep);
    }
    if (!run) return false;
    const isSame = (now) => now.run?.key === run.key;
    if (run.own_demonstrations && !this.demonstrations) {
      return this.take(`./api/run/${run.key}/demonstrations`, isSame, (told) => { this.demonstrations = told; this.arrived("demonstrations"); });
    }
    const trial = run.trials.find((one) => !this.trials.has(one.number));
    if (!trial) return false;
    return this.take(`./api/run/${run.key}/${trial.number}`, isSame, (told) => { this.trials.set(trial.number, told); this.arrived("trial", trial.number); });
  }

  // Fetch one thing and keep it if it is still wanted; return whether to go on.
  async take(address, isWanted, keep) {
    let told;
    try { told = await getJson(address); } catch { return false; } // gone: what is told next says so
    if (isWanted(this.session)) keep(told);
    return true;
  }
}
