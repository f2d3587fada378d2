// Methods, their common state, and what every view is made of: controls, plot and legend.
const DATA = JSON.parse(document.getElementById("view-data").textContent);
const METHODS = DATA.methods || [];
const shown = new Map(METHODS.map((m) => [m.name, !m.dashed]));
const redraws = [];

const NEAREST = { name: "nearest", label: "Nearest measured pulse", colour: "#000", dashed: false };
// measured pulses are broad and grey, so that a line on top of them is seen
const SOFT = { width: 5, opacity: 0.28 };

function methodOf(name) {
  const found = name === "nearest" ? NEAREST
    : METHODS.find((m) => m.name === name) || { name, label: name, colour: "#555", dashed: false };
  return /^(data|nearest)/.test(name) ? { ...found, ...SOFT } : found;
}

// in the page's order, then those that it does not know
function inOrder(names) {
  const known = METHODS.map((m) => m.name), rest = names.filter((n) => !known.includes(n));
  return [...known.filter((n) => names.includes(n)), ...rest];
}

const isShown = (name) => shown.get(name) !== false;

function toggle(name) {
  shown.set(name, !isShown(name));
  markButtons(document);
  redraws.forEach((redraw) => redraw());
}

function markButtons(root) {
  root.querySelectorAll("button[data-method]").forEach((button) => {
    const on = isShown(button.dataset.method);
    button.setAttribute("aria-pressed", String(on));
    button.closest("tr").classList.toggle("off", !on);
  });
}

// values behind packed(): offset + scale * integer, the most negative integer a NaN
function unpack(packed) {
  if (packed.values) return packed.values;
  const bytes = Uint8Array.from(atob(packed.data), (c) => c.charCodeAt(0));
  const integers = packed.bits === 32 ? new Int32Array(bytes.buffer) : new Int16Array(bytes.buffer);
  const none = -(2 ** (packed.bits - 1));
  packed.values = Array.from(integers, (v) => (v === none ? NaN : packed.offset + packed.scale * v));
  return packed.values;
}

function row(packed, index) {
  const width = packed.shape[1];
  return unpack(packed).slice(index * width, (index + 1) * width);
}

// columns that follow the cursor, which are left out on paper
const LIVE = ["at", "off"];
const live = (column) => (LIVE.includes(column) ? " class=\"live\"" : "");

// A table of methods; its first column switches them on and off, others are set by name.
// look(name): how this plot draws a method, if not as a line
class Legend {
  constructor(host, look = () => ({})) {
    this.host = host;
    this.look = look;
    this.key = null;
  }

  // names of methods, columns as [name, heading]; built anew only if these change
  build(names, columns) {
    const key = JSON.stringify([names, columns]);
    if (key === this.key) return;
    this.key = key;
    const head = columns.map(([column, title]) => `<th scope="col"${live(column)}>${title}</th>`).join("");
    const rows = names.map((name) => {
      const m = { width: 3, ...methodOf(name), ...this.look(name) };
      const dash = m.dashed ? " stroke-dasharray=\"5 3\"" : "";
      const swatch = `<svg class="swatch" viewBox="0 0 22 10" aria-hidden="true"><path stroke="${m.colour}" stroke-width="${m.width}" stroke-linecap="${m.cap || "butt"}" opacity="${m.opacity || 1}" fill="${m.fill || "none"}"${dash} d="${m.mark || "M1 5H21"}"/></svg>`;
      const cells = columns.map(([column]) => `<td data-cell="${escapeHtml(name)}/${column}"${live(column)}></td>`).join("");
      return `<tr><th scope="row"><button type="button" data-method="${escapeHtml(name)}">${swatch}${escapeHtml(m.label)}</button></th>${cells}</tr>`;
    });
    this.host.innerHTML = `<div class="scroll"><table class="legend"><thead><tr><th scope="col">Show</th>${head}</tr></thead><tbody>${rows.join("")}</tbody></table></div>`;
    this.cells = new Map([...this.host.querySelectorAll("td")].map((td) => [td.dataset.cell, td]));
    this.host.querySelectorAll("button").forEach((button) =>
      button.addEventListener("click", () => toggle(button.dataset.method)));
    markButtons(this.host);
  }

  set(name, column, text) {
    const cell = this.cells.get(`${name}/${column}`);
    if (cell) cell.textContent = text;
    // without a cursor they are empty
    const live = [...this.host.querySelectorAll("td.live")];
    if (LIVE.includes(column)) this.host.querySelector("table").classList.toggle("idle", live.every((td) => !td.textContent));
  }
}

// The frame of a view: a line of controls, the plot, a line of readout, the legend.
class View {
  constructor(host, options) {
    host.innerHTML = "<div class=\"controls\"></div><div class=\"pair\"><div class=\"drawn\"><div class=\"plot-host\"></div>" +
      "<p class=\"readout\" aria-live=\"polite\">&nbsp;</p></div><div class=\"legend-host\"></div></div><p class=\"gap\" hidden></p>";
    this.host = host;
    this.controls = host.querySelector(".controls");
    this.readout = host.querySelector(".readout");
    this.gap = host.querySelector(".gap");
    this.pair = host.querySelector(".pair");
    this.legend = new Legend(host.querySelector(".legend-host"), options.look);
    this.plot = new Plot(host.querySelector(".plot-host"), options);
  }

  select(title, choices, chosen) {
    const label = document.createElement("label");
    label.innerHTML = `${title} <select></select>`;
    this.controls.append(label);
    const select = label.querySelector("select");
    fill(select, choices);
    select.addEventListener("change", chosen);
    return select;
  }

  button(title, pressed, name = title) {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = title;
    button.setAttribute("aria-label", name);
    button.addEventListener("click", pressed);
    this.controls.append(button);
    return button;
  }

  // say why there is nothing, or show what there is
  missing(reason) {
    this.gap.hidden = !reason;
    this.pair.hidden = Boolean(reason);
    this.gap.textContent = reason ? `Nothing to show: ${reason}.` : "";
    return Boolean(reason);
  }

  say(text) {
    this.readout.textContent = text || "\u00a0";
  }
}

// options of a select; the chosen one stays if it is still there
function fill(select, choices) {
  const before = select.value;
  select.innerHTML = choices.map(([value, text]) => `<option value="${escapeHtml(value)}">${escapeHtml(text)}</option>`).join("");
  if (choices.some(([value]) => value === before)) select.value = before;
}

const withUnit = (info) => (info.unit ? `${info.label} [${info.unit}]` : info.label);
const pairs = (names) => names.map((name) => [name, name]);

// peaks that have something to show first
function peakChoices(peaks) {
  const gap = (name) => (typeof peaks[name].missing === "string" ? 1 : 0);
  return pairs(Object.keys(peaks).sort((a, b) => gap(a) - gap(b)));
}
