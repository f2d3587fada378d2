/* What is drawn once, and what mouse, fingers and keys do. */

/* ---- what stays ---- */

function drawHead() {
  const heads = [["Pulse", ""], ...Object.values(page.names)];
  if (page.measured) heads.push(["RMS difference", ""], ["Energy", "keV"], ["Event", ""]);
  const line = byId("head").insertRow();
  for (const [label, unit] of heads) {
    const cell = document.createElement("th");
    cell.textContent = label;
    if (unit) cell.appendChild(document.createElement("small")).textContent = ` [${unit}]`;
    line.appendChild(cell);
  }
  const several = page.runs.length > 1;
  byId("about").textContent = `${several ? "Runs" : "Run"} ${page.runs.join(", ")}; `
    + `one sample every ${page.dt_ns} ns; a place every ${page.step_mm} mm`
    + (several ? "; the translation is the mean of the runs, its band from the lowest to the "
      + "highest, ± their standard deviation" : "");
  byId("notes").textContent = page.notes.join(" ");
}

function drawLegend() {
  const rows = [["raw", "7 4", 1.8, 1], ["ren", "none", 1.8, 1]];
  if (page.measured) rows.push(["data", "none", 1.2, 0.6]);
  for (const [kind, dash, wide, opacity] of rows) {
    const item = byId("legend").appendChild(document.createElement("span"));
    const svg = element(item, "svg", { width: 30, height: 12 });
    if (kind === "ren" && page.runs.length > 1) {
      element(svg, "rect", { width: 30, height: 10, y: 1, fill: page.colours.ren, "fill-opacity": 0.3 });
    }
    element(svg, "path", { d: "M0 6H30", stroke: page.colours[kind], "stroke-width": wide,
      "stroke-dasharray": dash, "stroke-opacity": opacity });
    item.appendChild(document.createTextNode(
      kind === "data" ? `${page.labels.data}, nearest` : page.labels[kind]));
  }
}

function fillSelects() {
  const add = (id, value, label) =>
    byId(id).appendChild(Object.assign(document.createElement("option"), { value, textContent: label }));
  for (const [name, [label]] of Object.entries(page.names)) add("quantity", name, label);
  if (page.measured) add("quantity", "rms", "RMS difference from data");
  add("side", "ideal", page.labels.raw);
  add("side", "ren", page.labels.ren);
  byId("quantity").addEventListener("change", (event) => {
    state.quantity = event.target.value;
    byId("side").disabled = state.quantity === "rms";
    drawCrystal();
  });
  byId("side").addEventListener("change", (event) => { state.side = event.target.value; drawCrystal(); });
}

/* ---- hands ---- */

function choose(place) {
  if (place === undefined || place === state.place) return;
  state.place = place;
  state.heights = {};
  markPlace();
  drawPulses();
}

function chooseAt(event) {
  const box = byId("crystal").firstChild.getBoundingClientRect();
  const { left, top, scale, h } = crystalScale;
  const r = (event.clientX - box.left - left) / scale;
  const z = (top + h - (event.clientY - box.top)) / scale;
  const margin = 2 * page.step_mm;
  if (r < -margin || z < -margin || r > page.outline.radius + margin
    || z > page.outline.length + margin) return;
  choose(nearestPlace(r, z, page.row.map((_, i) => i)));
}

const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

function move(event) {
  const way = ARROWS[event.key];
  if (!way || event.altKey || event.ctrlKey || event.metaKey) return;
  event.preventDefault();
  const r = page.r_mm[state.place], z = page.z_mm[state.place];
  // the next place on the same line, across bore and ditch
  const ahead = shown.map((i) => {
    const [dr, dz] = [page.r_mm[i] - r, page.z_mm[i] - z];
    return { i, along: dr * way[0] + dz * way[1], off: Math.abs(dr * way[1]) + Math.abs(dz * way[0]) };
  }).filter((p) => p.along > 0.5 * page.step_mm && p.off < 0.5 * page.step_mm);
  ahead.sort((a, b) => a.along - b.along);
  if (ahead.length) choose(ahead[0].i);
}

function setView(view) {
  state.view = view;
  state.heights = {};
  drawPulses();
}

function zoomable(id) {
  let start = null, frame = null;
  const at = (event) => {
    const box = byId(id).firstChild.getBoundingClientRect(), p = plots[id];
    return [Math.min(Math.max(event.clientX - box.left, p.left), p.left + p.width),
            Math.min(Math.max(event.clientY - box.top, p.top), p.top + p.height)];
  };
  byId(id).addEventListener("pointerdown", (event) => {
    if (event.button) return;
    start = at(event);
    frame = element(byId(id).firstChild, "rect", { fill: "#000", "fill-opacity": 0.08, stroke: "#666" });
    try { byId(id).setPointerCapture(event.pointerId); } catch { /* not a true pointer */ }
  });
  byId(id).addEventListener("pointermove", (event) => {
    if (!start) return;
    const end = at(event), p = plots[id], tall = Math.abs(end[1] - start[1]) > 15;
    const attributes = { x: Math.min(start[0], end[0]), width: Math.abs(end[0] - start[0]),
      y: tall ? Math.min(start[1], end[1]) : p.top,
      height: tall ? Math.abs(end[1] - start[1]) : p.height };
    for (const [key, value] of Object.entries(attributes)) frame.setAttribute(key, value);
  });
  const cancel = () => { start = null; if (frame) frame.remove(); };
  byId(id).addEventListener("pointercancel", cancel);
  byId(id).addEventListener("pointerup", (event) => {
    if (!start) return;
    const [from, end, p] = [start, at(event), plots[id]];
    cancel();
    if (Math.abs(end[0] - from[0]) < 6) return;  // a click
    const t = (x) => p.from + (x - p.left) / p.width * (p.to - p.from);
    const v = (y) => p.high - (y - p.top) / p.height * (p.high - p.low);
    const view = [t(Math.min(from[0], end[0])), t(Math.max(from[0], end[0]))];
    if (view[1] - view[0] < page.dt_ns) return;
    state.view = view;
    state.heights = Math.abs(end[1] - from[1]) > 15
      ? { [id]: [v(Math.max(from[1], end[1])), v(Math.min(from[1], end[1]))] } : {};
    drawPulses();
  });
  byId(id).addEventListener("dblclick", () => setView(null));
}

let held = false;
byId("crystal").addEventListener("pointerdown", (event) => { held = true; chooseAt(event); });
byId("crystal").addEventListener("pointermove", (event) => { if (held) chooseAt(event); });
window.addEventListener("pointerup", () => { held = false; });
window.addEventListener("pointercancel", () => { held = false; });
byId("crystal").addEventListener("keydown", move);
byId("edge").addEventListener("click", () => setView(null));
byId("all").addEventListener("click", () => setView(wholeView));
["charge", "current"].forEach(zoomable);

function drawAll() { drawCrystal(); drawPulses(); }

let width = document.body.clientWidth;
window.addEventListener("resize", () => {
  if (document.body.clientWidth !== width) { width = document.body.clientWidth; drawAll(); }
});
drawHead();
drawLegend();
fillSelects();
drawAll();
