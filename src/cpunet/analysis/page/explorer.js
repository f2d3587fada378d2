// The pulses of a place: ideal, translated, and the measured ones nearest to the translation.
const byId = (id) => document.getElementById(id);
const lost = DATA.kernel.length - 1; // samples that the smoothing takes
const times = DATA.samples.map((s) => s * DATA.dt_ns);
const currentTimes = times.slice(0, DATA.edge - 1 - lost).map((t) => t + (0.5 + lost / 2) * DATA.dt_ns);
const columns = [...Object.entries(DATA.names).map(([name, [label, unit]]) => [name, `${label} [${unit}]`]),
  ...(DATA.measured ? [["rms", "RMS difference"], ["energy", "Energy [keV]"], ["event", "Event"]] : []), ["at", "Height"]];
let pulses = [];

const currentOf = (wave) => currentTimes.map((_, i) =>
  DATA.kernel.reduce((sum, weight, k) => sum + weight * (wave[i + k + 1] - wave[i + k]), 0));

const fixed = (value, digits) => (value === null || value === undefined ? "–" : formatted(value, 10 ** -digits));
const digitsOf = (name) => (name === "current_amplitude" ? 4 : 0);

// in the order of the table
function pulsesOf(at) {
  const found = [["raw", DATA.ideal], ["ren", DATA.ren]].map(([name, side]) => ({
    name, kind: name, wave: row(side.wave, at), number: (n) => side.numbers[n][at], spread: (n) => (side.spread ? side.spread[n][at] : null) }));
  if (!DATA.measured) return found;
  DATA.measured.nearest[at].forEach((index, rank) => {
    const rms = DATA.measured.rms[at][rank];
    if (rms !== null) {
      found.push({ name: `data ${rank + 1}`, kind: "data", wave: row(DATA.measured.wave, index), rms, number: (n) => DATA.measured.numbers[n][index],
        spread: () => null, energy: DATA.measured.energy_kev[index], event: DATA.measured.event_number[index] });
    }
  });
  return found;
}

// from just before the pulses of the crystal begin to as long after their middle
function edgeOfAll() {
  const begins = withPulse.map((i) => row(DATA.ren.wave, DATA.row[i]).findIndex((v, k) => v > 0.02 && k < DATA.edge)).filter((k) => k >= 0);
  const before = Math.min(0, times[Math.max(Math.min(DATA.edge, ...begins) - 5, 0)]);
  return [before, Math.min(Math.max(-before, 30 * DATA.dt_ns), times[DATA.edge - 1])];
}

const home = edgeOfAll();
const view = new View(byId("pulses"), {
  title: "Charge and current of a place; arrows move the cursor, plus and minus zoom, 0 shows the edge",
  box: true,
  ratio: 0.9,
  most: 620,
  onCursor: (x) => readout(x),
});
view.button("Edge", () => view.plot.zoomTo(null), "Show the rising edge");
view.button("All", () => view.plot.zoomTo([times[0], times[times.length - 1]]), "Show the whole pulse");

const crystal = new Crystal(byId("crystal"), choose);
const nearestIndex = (x) => times.reduce((best, t, i) => (Math.abs(t - x) < Math.abs(times[best] - x) ? i : best), 0);

function series(xs, lines, bands, at) {
  const drawn = pulses.map((pulse, i) => ({ pulse, ys: lines[i] })).filter(({ pulse }) => isShown(pulse.name));
  const of = ({ pulse, ys }) => line(xs, ys, { name: pulse.kind, width: 1.8, ...methodOf(pulse.name) });
  const within = bands && isShown("ren") ? [band(xs, ...bands.map((b) => row(b, at)), { name: "band", colour: methodOf("ren").colour, opacity: 0.3 })] : [];
  const side = (kind) => drawn.filter(({ pulse }) => (pulse.kind === "data") === kind).map(of);
  return [...within, ...side(true), ...side(false)];
}

function draw() {
  const at = DATA.row[crystal.chosen];
  const where = `r = ${DATA.r_mm[crystal.chosen].toFixed(1)} mm, z = ${DATA.z_mm[crystal.chosen].toFixed(1)} mm`;
  const why = at < 0 ? `no pulse, ${DATA.reasons[DATA.reason[crystal.chosen]]}` : "";
  byId("where").textContent = why ? `${where}: ${why}` : where;
  pulses = at < 0 ? [] : pulsesOf(at);
  view.legend.build(pulses.map((pulse) => pulse.name), columns);
  pulses.forEach(fillRow);
  view.plot.show({
    key: "one",
    title: why || where,
    x: { label: "Time from half maximum [ns]", home },
    stride: DATA.dt_ns,
    snap: (x) => times[nearestIndex(x)],
    panels: [
      { id: "charge", label: "Charge, prepared", share: 1.5, zero: true, series: series(times, pulses.map((p) => p.wave), DATA.ren.band, at) },
      { id: "current", label: "Current [1/sample]", share: 1, zero: true, series: series(currentTimes, pulses.map((p) => currentOf(p.wave)), DATA.ren.current_band, at) },
    ],
  });
  readout(null);
}

function fillRow(pulse) {
  for (const name of Object.keys(DATA.names)) {
    const spread = pulse.spread(name), value = fixed(pulse.number(name), digitsOf(name));
    view.legend.set(pulse.name, name, spread === null ? value : `${value} ± ${Number(spread.toPrecision(2))}`);
  }
  view.legend.set(pulse.name, "rms", fixed(pulse.rms, 4));
  view.legend.set(pulse.name, "energy", fixed(pulse.energy, 1));
  view.legend.set(pulse.name, "event", String(pulse.event ?? "–"));
}

function readout(x) {
  const i = x === null ? -1 : nearestIndex(x);
  pulses.forEach((pulse) => view.legend.set(pulse.name, "at", i < 0 ? "" : short(pulse.wave[i])));
  view.say(i < 0 ? "" : `${short(times[i])} ns`);
}

function choose(place) {
  if (place === crystal.chosen) return;
  crystal.place(place);
  if (view.plot.zoom) view.plot.zoom.y = null;
  draw();
}

function colour() {
  const name = byId("quantity").value, side = byId("side");
  side.disabled = name === "rms";
  const of = (at) => (name === "rms" ? DATA.measured.rms[at][0] : DATA[side.value].numbers[name][at]);
  const label = name === "rms" ? "RMS difference from the nearest measured" : columns.find(([column]) => column === name)[1];
  crystal.show(DATA.row.map((at) => (at < 0 ? null : of(at))), label);
}

fill(byId("quantity"), [...Object.entries(DATA.names).map(([name, [label]]) => [name, label]), ...(DATA.measured ? [["rms", "RMS difference from data"]] : [])]);
fill(byId("side"), [["ideal", methodOf("raw").label], ["ren", methodOf("ren").label]]);
for (const id of ["quantity", "side"]) byId(id).addEventListener("change", colour);
crystal.chosen = nearestPlace(DATA.outline.radius / 2, DATA.outline.length / 2, withPulse);
redraws.push(draw);
colour();
draw();
