// Mean pulses by slice of rise time, and single events; both above their differences.
const EDGE = [0.01, 0.99]; // of the maximum

// the times at which a pulse begins and ends its rise, with some room; null if there is no pulse
function edgeOf(xs, ys) {
  const top = Math.max(...ys.filter(Number.isFinite));
  const [begin, end] = EDGE.map((part) => xs[ys.findIndex((y) => y > part * top)]);
  if (begin === undefined) return null;
  const room = Math.max((end - begin) * 0.15, xs[1] - xs[0]);
  return [begin - room, end + room];
}

// the translation is drawn last, so that nothing hides it
const onTop = (names) => [...names].sort((a, b) => (a === "ren") - (b === "ren"));

function times(data, samples) {
  return Array.from({ length: samples }, (_, i) => (i - data.before) * data.dt_ns);
}

function nearestTo(xs) {
  const step = xs[1] - xs[0];
  return (x) => xs[Math.min(xs.length - 1, Math.max(0, Math.round((x - xs[0]) / step)))];
}

const percent = (v) => (Number.isFinite(v) ? `${v < 0 ? "−" : "+"}${Math.abs(v).toPrecision(2)} %` : "–");

function mountSuperpulses(host, data) {
  const columns = [["n", "Pulses"], ["at", "Height"], ["off", "Minus data"]];
  let xs = [], means = {}, residuals = {}, sigma = {};
  const edge = () => xs.length && view.plot.zoomTo(edgeOf(xs, means.data || Object.values(means)[0]));
  const view = new View(host, {
    title: "Mean pulses by method, and their differences from the data's",
    onCursor: (x) => readout(x),
  });
  const peak = view.select("Peak", peakChoices(data.peaks), update);
  const slice = view.select("Rise time 1–90 %", [], update);
  view.button("Edge", edge, "Show the rising edge");
  view.button("All", () => view.plot.zoomTo(null), "Show the whole pulse");
  const scale = scaleBox(view, update);
  redraws.push(update);
  update();
  edge();

  function update() {
    const found = data.peaks[peak.value];
    slice.disabled = Boolean(found.missing);
    if (view.missing(found.missing)) return;
    fill(slice, found.slices.map((text, i) => [String(i), text]));
    const k = Number(slice.value), names = inOrder(Object.keys(found.methods));
    xs = times(data, found.methods[names[0]].mean.shape[1]);
    means = {};
    residuals = {};
    sigma = {};
    for (const name of names) {
      means[name] = row(found.methods[name].mean, k);
      sigma[name] = row(found.methods[name].error, k);
    }
    const base = means.data;
    const upper = [], lower = [];
    if (base && isShown("data")) {
      upper.push(line(xs, base, methodOf("data")));
      lower.push(band(xs, sigma.data.map((e) => -100 * e), sigma.data.map((e) => 100 * e), { colour: "#000", opacity: 0.2 }));
    }
    view.legend.build(names, columns);
    for (const name of onTop(names)) {
      view.legend.set(name, "n", String(found.methods[name].n[k]));
      if (!base || name === "data") { if (!base && isShown(name)) upper.push(line(xs, means[name], methodOf(name))); continue; }
      const { colour, dashed } = methodOf(name), fit = scale.checked || name !== "raw";
      const residual = means[name].map((y, i) => 100 * (y - base[i]));
      residuals[name] = residual;
      if (!isShown(name)) continue;
      upper.push(line(xs, means[name], { colour, dashed }));
      lower.push(band(xs, residual.map((r, i) => r - 100 * sigma[name][i]), residual.map((r, i) => r + 100 * sigma[name][i]), { colour, fit }));
      lower.push(line(xs, residual, { colour, dashed, fit, width: 1.3 }));
    }
    view.plot.show({
      key: "one",
      title: `${peak.value}, rise time 1–90 % ${found.slices[k]}: mean pulses`,
      x: { label: "Time from half maximum [ns]", home: [xs[0], xs[xs.length - 1]] },
      stride: data.dt_ns,
      snap: nearestTo(xs),
      panels: [
        { label: "Pulse height", share: 1.3, series: upper },
        { label: base ? "Minus data [% of charge]" : "No data to compare", share: 1, symmetric: true, series: lower },
      ],
    });
    readout(null);
  }

  function readout(x) {
    const i = x === null ? -1 : Math.round((x - xs[0]) / data.dt_ns);
    for (const name of Object.keys(means)) {
      view.legend.set(name, "at", i < 0 ? "" : short(means[name][i]));
      view.legend.set(name, "off", i < 0 || !residuals[name] ? "" : `${percent(residuals[name][i])} ± ${short(Number((100 * Math.hypot(sigma[name][i], sigma.data[i])).toPrecision(2)))}`);
    }
    view.say(i < 0 ? "Drag to zoom, double-click for all." : `${short(xs[i])} ns`);
  }
}

// whether the differences of the untranslated simulation, tens of percent, set the scale
function scaleBox(view, update) {
  const label = document.createElement("label");
  label.innerHTML = "<input type=\"checkbox\"> include the raw simulation in the scale";
  view.controls.append(label);
  const box = label.querySelector("input");
  box.addEventListener("change", update);
  return box;
}

function mountPulses(host, data) {
  let xs = [], pulses = {}, reference = null;
  const edge = () => xs.length && view.plot.zoomTo(edgeOf(xs, pulses.ren || Object.values(pulses)[0]));
  const view = new View(host, {
    title: "One simulated event by each method, without noise",
    onCursor: (x) => readout(x),
  });
  const peak = view.select("Peak", peakChoices(data.peaks), () => { slider.value = 0; update(); });
  view.button("‹", () => step(-1), "Previous event");
  const holder = document.createElement("label");
  holder.innerHTML = "Event <input type=\"range\" min=\"0\" step=\"1\" value=\"0\"> <output></output>";
  view.controls.append(holder);
  const slider = holder.querySelector("input"), number = holder.querySelector("output");
  slider.addEventListener("input", update);
  view.button("›", () => step(1), "Next event");
  view.button("Edge", edge, "Show the rising edge");
  view.button("All", () => view.plot.zoomTo(null), "Show the whole window");
  const scale = scaleBox(view, update);
  redraws.push(update);
  update();
  edge();

  function step(by) {
    slider.value = Number(slider.value) + by;
    update();
  }

  function update() {
    const found = data.peaks[peak.value];
    slider.disabled = Boolean(found.missing);
    if (view.missing(found.missing)) return;
    slider.max = found.rows.length - 1;
    const k = Number(slider.value);
    number.textContent = `${k + 1} of ${found.rows.length} (simulated pulse ${found.rows[k]})`;
    pulses = Object.fromEntries(Object.entries(found.methods).map(([name, packed]) => [name, row(packed, k)]));
    if (found.nearest) pulses.nearest = row(found.nearest, k);
    reference = ["truth", "nearest"].find((name) => pulses[name]) || null;
    const names = inOrder(Object.keys(pulses));
    xs = times(data, pulses[names[0]].length);
    const upper = [], lower = [];
    const what = reference && methodOf(reference).label.toLowerCase();
    view.legend.build(names, [["at", "Height"], ["off", reference ? `Minus ${what}` : "–"], ["rms", "Its RMS"]]);
    const wide = names.includes("nearest") && isShown("nearest");
    if (wide) upper.push(line(xs, pulses.nearest, methodOf("nearest")));
    for (const name of onTop(names)) {
      const { colour, dashed } = methodOf(name), fit = scale.checked || name !== "raw";
      const residual = reference ? pulses[name].map((y, i) => 100 * (y - pulses[reference][i])) : [];
      const known = residual.filter(Number.isFinite);
      const rms = Math.sqrt(known.reduce((sum, r) => sum + r * r, 0) / known.length);
      view.legend.set(name, "rms", !reference || name === reference ? "" : `${short(rms)} %`);
      if (!isShown(name)) continue;
      if (name !== "nearest") upper.push(line(xs, pulses[name], { colour, dashed }));
      if (reference && name !== reference) lower.push(line(xs, residual, { colour, dashed, fit, width: name === "nearest" ? 0.8 : 1.4, opacity: name === "nearest" ? 0.6 : 1 }));
    }
    view.plot.show({
      key: "one",
      title: `${peak.value}: simulated pulse ${found.rows[k]}`,
      x: { label: "Time from half maximum [ns]", home: [xs[0], xs[xs.length - 1]] },
      stride: data.dt_ns,
      snap: nearestTo(xs),
      panels: [
        { label: "Pulse height", share: 1.3, series: upper },
        ...(reference ? [{ label: reference === "truth" ? "Minus truth [%]" : "Minus measured [%]", share: 1, symmetric: true, series: lower }] : []),
      ],
    });
    readout(null);
  }

  function readout(x) {
    const found = data.peaks[peak.value], i = x === null ? -1 : Math.round((x - xs[0]) / data.dt_ns);
    for (const name of Object.keys(pulses)) {
      view.legend.set(name, "at", i < 0 ? "" : short(pulses[name][i]));
      const off = reference && name !== reference && i >= 0;
      view.legend.set(name, "off", off ? percent(100 * (pulses[name][i] - pulses[reference][i])) : "");
    }
    if (i >= 0) return view.say(`${short(xs[i])} ns`);
    const to = found.nearest ? ` The measured pulse is another event: of ${found.searched}, the one nearest to “${methodOf(found.nearest_to).label}”.` : "";
    return view.say(`${found.usable} of ${found.n} events can be shown by every method.${to}`);
  }
}
