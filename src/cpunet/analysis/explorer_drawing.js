/* The pictures: the crystal's cross-section, charge, current, numbers. */

/* ---- drawing ---- */

function element(parent, name, attributes, text) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes || {})) made.setAttribute(key, value);
  if (text !== undefined) made.textContent = text;
  parent.appendChild(made);
  return made;
}

function blank(id, width, height, title) {
  const box = byId(id);
  box.textContent = "";
  const svg = element(box, "svg", { viewBox: `0 0 ${width} ${height}`, width, height, role: "img" });
  element(svg, "title", {}, title);
  return svg;
}

function ticks(low, high, wanted) {
  const raw = (high - low) / wanted, power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((m) => m * power).find((s) => s >= raw * 0.999);
  const first = Math.ceil(low / step - 1e-9), last = Math.floor(high / step + 1e-9);
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  return Array.from({ length: last - first + 1 }, (_, i) => ({
    value: (first + i) * step, text: ((first + i) * step).toFixed(digits).replace("-", "−") }));
}

const text = (value, digits) => value === null || value === undefined ? "–"
  : value.toFixed(digits).replace("-", "−");
const digitsOf = (name) => name === "current_amplitude" ? 4 : name === "rms" ? 4 : 0;

/* ---- crystal ---- */

function quantityValues() {
  if (state.quantity === "rms") {
    return page.row.map((row) => row < 0 ? null : page.measured.rms[row][0]);
  }
  const numbers = page[state.side].numbers[state.quantity];
  return page.row.map((row) => row < 0 ? null : numbers[row]);
}

function quantityLabel() {
  if (state.quantity === "rms") return "RMS difference from the nearest measured";
  const [label, unit] = page.names[state.quantity];
  return `${label} [${unit}]`;
}

let crystalScale = null;

function drawCrystal() {
  const { radius, length } = page.outline;
  const width = byId("crystal").clientWidth || 380;
  const left = 44, right = 92, top = 8, bottom = 40;
  const tallest = Math.max(300, Math.min(620, 1.5 * width));
  const scale = Math.min((width - left - right) / radius, (tallest - top - bottom) / length);
  const w = radius * scale, h = length * scale;
  const x = (r) => left + r * scale, y = (z) => top + h - z * scale;
  crystalScale = { left, top, scale, h };
  const svg = blank("crystal", width, h + top + bottom, "Cross-section of the crystal");
  const trace = (lines) => (lines || []).map((line) =>
    "M" + line.map(([r, z]) => `${x(r).toFixed(1)} ${y(z).toFixed(1)}`).join("L") + "Z").join("");
  const clip = element(element(svg, "defs"), "clipPath", { id: "inside" });
  element(clip, "path", { d: trace(page.outline.crystal), "clip-rule": "evenodd" });
  const values = quantityValues(), known = values.filter((v) => v !== null);
  let low = Math.min(...known), high = Math.max(...known);
  if (!known.length) [low, high] = [0, 1];
  if (high <= low) [low, high] = [low - 0.5, high + 0.5];
  const colour = (v) => page.map[Math.round((v - low) / (high - low) * (page.map.length - 1))];
  const cells = element(svg, "g", { "clip-path": "url(#inside)", "shape-rendering": "crispEdges" });
  element(cells, "path", { d: trace(page.outline.crystal), fill: LITHIUM });
  const side = page.step_mm * scale;
  page.r_mm.forEach((r, i) => element(cells, "rect", {
    class: page.row[i] < 0 ? "cell none" : "cell", x: (x(r) - side / 2).toFixed(2),
    y: (y(page.z_mm[i]) - side / 2).toFixed(2), width: (side + 0.3).toFixed(2),
    height: (side + 0.3).toFixed(2), fill: values[i] === null ? GREY : colour(values[i]) }));
  element(svg, "path", { d: trace(page.outline.active), fill: "none", stroke: "#fff",
    "stroke-width": 1, "stroke-opacity": 0.8 });
  element(svg, "path", { d: trace(page.outline.contact), fill: page.colours.truth });
  element(svg, "path", { d: trace(page.outline.crystal), fill: "none", stroke: "#000",
    "stroke-width": 1.2 });
  for (const t of ticks(0, radius, w / 55)) {
    element(svg, "line", { x1: x(t.value), x2: x(t.value), y1: y(0) + 2, y2: y(0) + 6, stroke: "#333" });
    element(svg, "text", { x: x(t.value), y: y(0) + 19, "text-anchor": "middle" }, t.text);
  }
  for (const t of ticks(0, length, h / 45)) {
    element(svg, "line", { x1: left - 6, x2: left - 2, y1: y(t.value), y2: y(t.value), stroke: "#333" });
    element(svg, "text", { x: left - 9, y: y(t.value) + 4, "text-anchor": "end" }, t.text);
  }
  element(svg, "text", { x: left + w / 2, y: y(0) + 35, "text-anchor": "middle" }, "r [mm]");
  rotated(svg, 12, top + h / 2, "z [mm]");
  drawBar(svg, left + w + 16, top, h, low, high);
  element(svg, "circle", { id: "chosen", r: 6, fill: "none", stroke: "#000", "stroke-width": 4 });
  element(svg, "circle", { id: "chosen-rim", r: 6, fill: "none", stroke: "#fff", "stroke-width": 2 });
  markPlace();
}

function rotated(svg, x, y, label) {
  element(svg, "text", { x, y, "text-anchor": "middle", transform: `rotate(-90 ${x} ${y})` }, label);
}

function drawBar(svg, x, top, h, low, high) {
  const shade = element(element(svg, "defs"), "linearGradient", { id: "shade", x1: 0, x2: 0, y1: 1, y2: 0 });
  page.map.forEach((colour, i) => element(shade, "stop", {
    offset: (i / (page.map.length - 1)).toFixed(4), "stop-color": colour }));
  element(svg, "rect", { x, y: top, width: 12, height: h, fill: "url(#shade)" });
  const marks = ticks(low, high, h / 50);
  for (const t of marks) {
    const y = top + h * (1 - (t.value - low) / (high - low));
    element(svg, "line", { x1: x + 12, x2: x + 15, y1: y, y2: y, stroke: "#333" });
    element(svg, "text", { x: x + 17, y: y + 4 }, t.text);
  }
  const widest = Math.max(0, ...marks.map((t) => t.text.length));
  rotated(svg, x + 32 + 7 * widest, top + h / 2, quantityLabel());
}

function markPlace() {
  const { left, top, scale, h } = crystalScale;
  for (const id of ["chosen", "chosen-rim"]) {
    byId(id).setAttribute("cx", left + page.r_mm[state.place] * scale);
    byId(id).setAttribute("cy", top + h - page.z_mm[state.place] * scale);
  }
}

/* ---- pulses ---- */

const plots = {};

function drawPulses() {
  const row = page.row[state.place];
  const pulses = row < 0 ? [] : pulsesOf(row);
  const currents = pulses.map((pulse) => currentOf(pulse.wave));
  drawPlot("charge", "Charge, prepared", times, pulses, pulses.map((p) => p.wave), 0.62, row);
  drawPlot("current", "Current [1/sample]", currentTimes, pulses, currents, 0.42, row);
  drawNumbers(pulses);
  const r = page.r_mm[state.place].toFixed(1), z = page.z_mm[state.place].toFixed(1);
  byId("where").textContent = `r = ${r} mm, z = ${z} mm`
    + (row < 0 ? `: no pulse, ${page.reasons[page.reason[state.place]]}` : "");
}

function drawPlot(id, label, time, pulses, lines, ratio, row) {
  const width = byId(id).clientWidth || 380;
  const height = Math.round(Math.min(Math.max(ratio * width, 170), 600 * ratio));
  const left = 56, right = 10, top = 8, bottom = id === "current" ? 40 : 24;
  const [from, to] = state.view || edgeView;
  const [low, high] = state.heights[id] || extent(time, lines, from, to);
  const x = (t) => left + (t - from) / (to - from) * (width - left - right);
  const y = (v) => top + (high - v) / (high - low) * (height - top - bottom);
  plots[id] = { left, top, width: width - left - right, height: height - top - bottom,
                from, to, low, high };
  const svg = blank(id, width, height, label);
  const clip = element(element(svg, "defs"), "clipPath", { id: `frame-${id}` });
  element(clip, "rect", { x: left, y: top, width: width - left - right, height: height - top - bottom });
  for (const t of ticks(from, to, width / 90)) {
    element(svg, "line", { x1: x(t.value), x2: x(t.value), y1: top, y2: height - bottom, stroke: "#ebebeb" });
    element(svg, "text", { x: x(t.value), y: height - bottom + 16, "text-anchor": "middle" }, t.text);
  }
  for (const t of ticks(low, high, height / 45)) {
    element(svg, "line", { x1: left, x2: width - right, y1: y(t.value), y2: y(t.value), stroke: "#ebebeb" });
    element(svg, "text", { x: left - 6, y: y(t.value) + 4, "text-anchor": "end" }, t.text);
  }
  element(svg, "path", { d: `M${left} ${top}V${height - bottom}H${width - right}`, fill: "none", stroke: "#333" });
  rotated(svg, 12, top + (height - top - bottom) / 2, label);
  if (id === "current") {
    element(svg, "text", { x: left + (width - left - right) / 2, y: height - 6, "text-anchor": "middle" },
      "Time from half maximum [ns]");
  }
  const inner = element(svg, "g", { "clip-path": `url(#frame-${id})`, fill: "none", "stroke-linejoin": "round" });
  if (row < 0) {
    element(svg, "text", { x: left + (width - left - right) / 2, y: height / 2, "text-anchor": "middle" },
      "no pulse at this place");
    return;
  }
  if (bands[id].length) drawBand(inner, id, time, row, x, y);
  pulses.forEach((pulse, i) => element(inner, "path", { class: pulse.kind,
    d: path(time, lines[i], x, y), stroke: pulse.colour, "stroke-dasharray": pulse.dash || "none",
    "stroke-width": pulse.kind === "data" ? 1 : 1.8,
    "stroke-opacity": pulse.kind === "data" ? 0.45 : 1 }));
}

function drawBand(parent, id, time, row, x, y) {
  const [low, high] = bands[id].map((read) => read(row));
  const there = time.map((_, i) => i).filter((i) => !isNaN(low[i]) && !isNaN(high[i]));
  const upper = there.map((i) => `${x(time[i]).toFixed(1)} ${y(high[i]).toFixed(1)}`);
  const lower = there.map((i) => `${x(time[i]).toFixed(1)} ${y(low[i]).toFixed(1)}`).reverse();
  element(parent, "path", { class: "band", d: `M${upper.concat(lower).join("L")}Z`,
    fill: page.colours.ren, "fill-opacity": 0.3 });
}

function path(time, line, x, y) {
  let d = "", pen = "M";
  for (let i = 0; i < time.length; i++) {
    if (isNaN(line[i])) { pen = "M"; continue; }
    d += `${pen}${x(time[i]).toFixed(1)} ${y(line[i]).toFixed(2)}`;
    pen = "L";
  }
  return d;
}

function extent(time, lines, from, to) {
  let low = 0, high = 0;
  for (const line of lines) {
    for (let i = 0; i < time.length; i++) {
      if (time[i] < from || time[i] > to || isNaN(line[i])) continue;
      if (line[i] < low) low = line[i];
      if (line[i] > high) high = line[i];
    }
  }
  if (high <= low) high = low + 1;
  const margin = 0.05 * (high - low);
  return [low - margin, high + margin];
}

function drawNumbers(pulses) {
  const order = pulses.slice().sort((a, b) => rank(a) - rank(b));
  byId("numbers").textContent = "";
  for (const pulse of order) {
    const line = byId("numbers").insertRow();
    const name = document.createElement("th");
    name.textContent = pulse.label;
    line.appendChild(name);
    for (const key of Object.keys(page.names)) {
      let value = text(pulse.number(key), digitsOf(key));
      if (pulse.spread && pulse.spread(key) !== null) {
        value += ` ± ${Number(pulse.spread(key).toPrecision(2))}`;
      }
      line.insertCell().textContent = value;
    }
    if (page.measured) {
      line.insertCell().textContent = text(pulse.rms, 4);
      line.insertCell().textContent = text(pulse.energy, 1);
      line.insertCell().textContent = pulse.event === undefined ? "–" : pulse.event;
    }
  }
}

const rank = (pulse) => ["raw", "ren", "data"].indexOf(pulse.kind);
