// A mixture of (state, action) pairs: conditioned on a state, and its donut; for the first action.
//
//   h_k ∝ π_k N(ξ; μ_k, Σ_k),   m_k = μ_a + G_k (ξ − μ_k),   S_k,   ε = V/s² / (1 + V/s²)
//   DMM(a) = Σ h_k [γ N(a; m_k, S_k/r_α²) − (γ − 1) N(a; m_k, S_k/r_β²)]

const FAR = 16; // squared standard deviations from every component, beyond the usual n

const normal = (a, mean, variance) =>
  Math.exp((-0.5 * (a - mean) ** 2) / variance) / Math.sqrt(2 * Math.PI * variance);

export class Model {
  constructor(told, columns) {
    this.told = told;
    const names = columns.map((column) => column.name);
    this.indices = told.state.map((name) => names.indexOf(name));
    this.isScalar = told.scale.length === 1;
  }

  at(observation) {
    const t = this.told, x = this.indices.map((i) => observation[i]);
    let nearest = Infinity;
    const logs = t.state_means.map((mean, k) => {
      let squared = 0;
      for (const row of t.state_whiteners[k]) {
        let y = 0;
        for (let i = 0; i < x.length; i++) y += row[i] * (x[i] - mean[i]);
        squared += y * y;
      }
      nearest = Math.min(nearest, squared);
      return t.state_constants[k] - 0.5 * squared;
    });
    const top = Math.max(...logs);
    const raw = logs.map((value) => Math.exp(value - top));
    const total = raw.reduce((a, b) => a + b, 0);
    const h = raw.map((value) => value / total);
    const all = t.gains.map((gain, k) => gain.map((row, j) =>
      t.action_means[k][j] + row.reduce((sum, g, i) => sum + g * (x[i] - t.state_means[k][i]), 0)));
    // ε is of all actions together: the mean of V/s² over them.
    let spread = 0;
    for (let j = 0; j < t.scale.length; j++) {
      const mean = h.reduce((sum, weight, k) => sum + weight * all[k][j], 0);
      const variance = h.reduce((sum, weight, k) =>
        sum + weight * (t.action_covariances[k][j][j] + (all[k][j] - mean) ** 2), 0);
      spread += variance / t.scale[j] ** 2 / t.scale.length;
    }
    const m = all.map((means) => means[0]), S = t.action_covariances.map((c) => c[0][0]);
    const mean = h.reduce((sum, weight, k) => sum + weight * m[k], 0);
    const epsilon = spread / (1 + spread);
    return { h, m, S, mean, epsilon, isFar: nearest > FAR + x.length, deviation: Math.sqrt(h.reduce((s, w, k) => s + w * (S[k] + (m[k] - mean) ** 2), 0)) };
  }

  gaussian(c, a) {
    return c.h.reduce((sum, weight, k) => sum + weight * normal(a, c.m[k], c.S[k]), 0);
  }

  donut(c, a) {
    const { k: ratio, reach } = this.told;
    const gamma = 1 + c.epsilon / (ratio - 1), alpha = 1 / (1 + (reach - 1) * c.epsilon), beta = ratio * alpha;
    return c.h.reduce((sum, weight, k) => sum + weight * (
      gamma * normal(a, c.m[k], c.S[k] / alpha ** 2) - (gamma - 1) * normal(a, c.m[k], c.S[k] / beta ** 2)), 0);
  }

  // Ellipses of n standard deviations in the plane of one state column and the first action.
  ellipses(column, deviations = 3) {
    const t = this.told, i = t.state.indexOf(column), j = t.state.length;
    if (i < 0) return [];
    return t.means.map((mean, k) => {
      const C = t.covariances[k];
      return { centre: [mean[i], mean[j]], covariance: [C[i][i], C[i][j], C[j][j]], deviations, weight: t.weights[k] };
    });
  }
}
