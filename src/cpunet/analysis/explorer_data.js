/* The pulses of the page, and what is chosen of them. */

const page = JSON.parse(document.getElementById("data").textContent);
const byId = (id) => document.getElementById(id);
const SVG = "http://www.w3.org/2000/svg";
const MISSING = -32768;
const GREY = "#c8c8c8", LITHIUM = "#e4e4e4";

/* ---- data ---- */

function unpack(packed) {
  const bytes = Uint8Array.from(atob(packed.data), (c) => c.charCodeAt(0));
  const view = new DataView(bytes.buffer), [rows, columns] = packed.shape;
  return (row) => {
    const values = new Float64Array(columns);
    for (let i = 0; i < columns; i++) {
      const n = view.getInt16(2 * (row * columns + i), true);
      values[i] = n === MISSING ? NaN : n * packed.scale;
    }
    return row < rows ? values : null;
  };
}

const waves = { ideal: unpack(page.ideal.wave), ren: unpack(page.ren.wave) };
if (page.measured) waves.measured = unpack(page.measured.wave);
const bands = { charge: (page.ren.band || []).map(unpack),
                current: (page.ren.current_band || []).map(unpack) };
const times = page.samples.map((s) => s * page.dt_ns);
const lost = page.kernel.length - 1;  // samples that the smoothing takes
const currentTimes = times.slice(0, page.edge - 1 - lost)
  .map((t) => t + (0.5 + lost / 2) * page.dt_ns);

function currentOf(wave) {
  return currentTimes.map((_, i) => page.kernel.reduce(
    (sum, weight, k) => sum + weight * (wave[i + k + 1] - wave[i + k]), 0));
}

/* Pulses of a place, in the order in which they are drawn. */
function pulsesOf(row) {
  const pulses = [];
  if (page.measured) page.measured.nearest[row].forEach((index, rank) => {
    const rms = page.measured.rms[row][rank];
    if (rms === null) return;
    pulses.push({ kind: "data", label: `${page.labels.data} ${rank + 1}`,
      colour: page.colours.data, wave: waves.measured(index), rms,
      energy: page.measured.energy_kev[index], event: page.measured.event_number[index],
      number: (name) => page.measured.numbers[name][index] });
  });
  for (const [kind, side, style] of [["raw", "ideal", "7 4"], ["ren", "ren", ""]]) {
    const spread = page[side].spread;
    pulses.push({ kind, label: page.labels[kind], colour: page.colours[kind], dash: style,
      wave: waves[side](row), number: (name) => page[side].numbers[name][row],
      spread: spread && ((name) => spread[name][row]) });
  }
  return pulses;
}

/* ---- state ---- */

const shown = page.row.map((row, i) => i).filter((i) => page.row[i] >= 0);
const state = { place: firstPlace(), quantity: Object.keys(page.names)[0], side: "ideal",
                view: null, heights: {} };

function firstPlace() {
  const r = page.outline.radius / 2, z = page.outline.length / 2;
  return nearestPlace(r, z, shown);
}

function nearestPlace(r, z, among) {
  let best = among[0], least = Infinity;
  for (const i of among) {
    const d = Math.hypot(page.r_mm[i] - r, page.z_mm[i] - z);
    if (d < least) { least = d; best = i; }
  }
  return best;
}

/* From just before the pulses of the crystal begin to as long after their middle. */
const edgeView = (() => {
  let first = page.edge;
  for (const i of shown) {
    const wave = waves.ren(page.row[i]);
    const begin = wave.findIndex((value, k) => value > 0.02 && k < page.edge);
    if (begin >= 0 && begin < first) first = begin;
  }
  const before = Math.min(0, times[Math.max(first - 5, 0)]);
  return [before, Math.min(Math.max(-before, 30 * page.dt_ns), times[page.edge - 1])];
})();
const wholeView = [times[0], times[times.length - 1]];
