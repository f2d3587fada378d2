// A plot of one or two panels over a common x axis, drawn as SVG text, with zoom and cursor.
const MARGIN = { left: 62, right: 20, top: 26, bottom: 44, gap: 14 };
const DRAG = 5; // pixels, below which a drag is a click
let plots = 0;

function escapeHtml(text) {
  return String(text).replace(/[&<>"]/g, (c) => `&#${c.charCodeAt(0)};`);
}

function niceStep(span, count) {
  const rough = span / Math.max(count, 1);
  const power = 10 ** Math.floor(Math.log10(rough));
  return [1, 2, 5, 10].map((m) => m * power).find((step) => step >= rough * 0.999) || power;
}

function ticks([low, high], count) {
  if (!(high > low)) return { step: 1, at: [low] };
  const step = niceStep(high - low, count);
  const at = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + step * 1e-9; i++) at.push(i * step);
  return { step, at };
}

function formatted(value, step) {
  if (!Number.isFinite(value)) return "–";
  const digits = Math.max(0, Math.min(12, -Math.floor(Math.log10(step) + 1e-9)));
  const text = value.toFixed(digits);
  return (Number(text) === 0 ? text.replace("-", "") : text).replace("-", "−");
}

// four digits, as in the tables of the page
function short(value) {
  if (!Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  const text = size !== 0 && (size < 1e-4 || size >= 1e6)
    ? value.toExponential(2) : String(Number(value.toPrecision(4)));
  return text.replaceAll("-", "−");
}

class Plot {
  // options: title, ratio and most of the height, box (zoom in y as well), onCursor(x or null)
  constructor(host, options) {
    this.options = options;
    this.id = `plot${++plots}`;
    this.zoom = null;
    host.innerHTML = `<svg class="plot" role="group" tabindex="0" aria-label="${escapeHtml(options.title)}">` +
      "<g class=\"body\"></g><g class=\"over\"></g></svg>";
    this.svg = host.firstChild;
    this.body = this.svg.querySelector(".body");
    this.over = this.svg.querySelector(".over");
    this.listen();
    // the drawing sets the height: only the width calls for a new one, and not within the event
    new ResizeObserver(() => {
      if (host.clientWidth !== this.width) requestAnimationFrame(() => this.draw());
    }).observe(host);
  }

  // spec: key, title, x {label, home}, panels [{label, share, series, zero, symmetric, home, id}], snap(x)
  show(spec) {
    if (!this.spec || this.spec.key !== spec.key) this.zoom = null;
    this.spec = spec;
    this.draw();
  }

  // y is of one of the panels
  zoomTo(x, y = null, panel = 0) {
    this.zoom = x && { x, y, panel };
    this.cursor(null);
    this.draw();
  }

  zoomAlong(x) {
    const { y, panel } = this.zoom || {};
    this.zoomTo(x, y, panel);
  }

  range() {
    return this.zoom ? this.zoom.x : this.spec.x.home;
  }

  draw() {
    const width = this.svg.parentNode.clientWidth;
    if (!this.spec || width < 50) return;
    this.width = width;
    const small = width < 480;
    const height = Math.round(Math.min(this.options.most || 470, Math.max(340, width * (this.options.ratio || 0.62))));
    this.svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    const x0 = MARGIN.left, x1 = width - MARGIN.right;
    const [low, high] = this.range();
    this.toX = (v) => x0 + ((v - low) / (high - low)) * (x1 - x0);
    this.fromX = (px) => low + ((px - x0) / (x1 - x0)) * (high - low);
    this.box = { x0, x1, y0: MARGIN.top, y1: height - MARGIN.bottom };
    const panels = this.spec.panels;
    const room = this.box.y1 - this.box.y0 - MARGIN.gap * (panels.length - 1);
    const shares = panels.reduce((sum, p) => sum + (p.share || 1), 0);
    const xt = ticks([low, high], small ? 5 : 8);
    let top = this.box.y0;
    // a long title begins further left, and is squeezed where that does not suffice
    const long = 7.6 * this.spec.title.length, start = Math.max(4, Math.min(x0, width - long));
    const squeezed = long > width ? ` textLength="${width - 8}" lengthAdjust="spacingAndGlyphs"` : "";
    let out = `<text class="title" x="${start}" y="15"${squeezed}>${escapeHtml(this.spec.title)}</text>`;
    panels.forEach((panel, i) => {
      const bottom = top + (room * (panel.share || 1)) / shares;
      out += this.drawPanel(panel, i, top, bottom, xt, small);
      top = bottom + MARGIN.gap;
    });
    for (const v of xt.at) {
      out += `<text class="tick" x="${this.toX(v).toFixed(1)}" y="${this.box.y1 + 17}" text-anchor="middle">${formatted(v, xt.step)}</text>`;
    }
    out += `<text class="name" x="${(x0 + x1) / 2}" y="${height - 7}" text-anchor="middle">${escapeHtml(this.spec.x.label)}</text>`;
    this.body.innerHTML = out;
    this.over.innerHTML = "";
  }

  drawPanel(panel, index, top, bottom, xt, small) {
    const { x0, x1 } = this.box;
    const [low, high] = this.zoom && this.zoom.y && index === this.zoom.panel ? this.zoom.y : this.yRange(panel);
    const toY = (v) => bottom - ((v - low) / (high - low)) * (bottom - top);
    panel.fromY = (py) => low + ((bottom - py) / (bottom - top)) * (high - low);
    panel.box = { top, bottom };
    const yt = ticks([low, high], Math.max(4, Math.min(6, (bottom - top) / 38)));
    let out = "";
    for (const v of xt.at) {
      const px = this.toX(v).toFixed(1);
      out += `<path class="grid" d="M${px} ${top}V${bottom}"/>`;
    }
    for (const v of yt.at) {
      const py = toY(v).toFixed(1);
      out += `<path class="${v === 0 && panel.symmetric ? "zero" : "grid"}" d="M${x0} ${py}H${x1}"/>` +
        `<text class="tick" x="${x0 - 6}" y="${Number(py) + 4}" text-anchor="end">${formatted(v, yt.step)}</text>`;
    }
    const clip = `${this.id}c${index}`;
    out += `<clipPath id="${clip}"><rect x="${x0}" y="${top}" width="${x1 - x0}" height="${bottom - top}"/></clipPath>`;
    out += `<g clip-path="url(#${clip})">${panel.series.map((s) => MARKS[s.kind](s, this.toX, toY)).join("")}</g>`;
    out += `<path class="frame" d="M${x0} ${top}V${bottom}H${x1}"/>`;
    const middle = (top + bottom) / 2;
    out += `<text class="name" transform="translate(${small ? 12 : 14} ${middle}) rotate(-90)" text-anchor="middle">${escapeHtml(panel.label)}</text>`;
    return panel.id ? `<g id="${panel.id}">${out}</g>` : out;
  }

  // of what is seen between the ends of x; series with fit: false do not count
  yRange(panel) {
    if (panel.home) return panel.home;
    const [from, to] = this.range();
    let low = panel.zero ? 0 : Infinity, high = -Infinity;
    for (const s of panel.series) {
      if (s.fit === false) continue;
      s.extent(from, to, (v) => {
        if (v < low) low = v;
        if (v > high) high = v;
      });
    }
    if (!(high >= low)) [low, high] = [0, 1];
    if (panel.symmetric) {
      high = Math.max(Math.abs(low), Math.abs(high), panel.least || 0) || 1;
      low = -high;
    }
    const margin = 0.06 * (high - low) || Math.abs(high) * 0.05 || 0.5;
    return [panel.zero ? low : low - margin, high + margin];
  }

  // x of the cursor in the axis' unit, or null to remove it
  cursor(x) {
    const known = x !== null && this.spec.snap;
    const at = known ? this.spec.snap(x) : null;
    this.at = at;
    this.over.innerHTML = at === null ? "" :
      `<path class="cursor" d="M${this.toX(at).toFixed(1)} ${this.box.y0}V${this.box.y1}"/>`;
    if (this.options.onCursor) this.options.onCursor(at);
  }

  listen() {
    const svg = this.svg;
    let start = null;
    const where = (event) => {
      const frame = svg.getBoundingClientRect();
      const { x0, x1, y0, y1 } = this.box;
      const scale = svg.viewBox.baseVal.width / frame.width;
      const inside = (v, a, b) => Math.min(Math.max(v, a), b);
      return {
        x: inside((event.clientX - frame.left) * scale, x0, x1),
        y: inside((event.clientY - frame.top) * scale, y0, y1),
      };
    };
    const panelAt = (y) => {
      const found = this.spec.panels.findIndex((panel) => y <= panel.box.bottom), index = found < 0 ? 0 : found;
      return { index, panel: this.spec.panels[index] };
    };
    // ends of a frame that zooms in y as well, within its panel; null if it does not
    const heights = (a, b, { box }) => this.options.box && Math.abs(a.y - b.y) >= DRAG
      && [a.y, b.y].sort((y, z) => y - z).map((y) => Math.min(Math.max(y, box.top), box.bottom));
    svg.addEventListener("pointerdown", (event) => {
      if (event.button !== 0 || !this.box) return;
      start = where(event);
      try { svg.setPointerCapture(event.pointerId); } catch (error) { /* a pointer already gone */ }
    });
    svg.addEventListener("pointermove", (event) => {
      if (!this.box) return;
      const now = where(event);
      if (!start) return this.cursor(this.fromX(now.x));
      const { y0, y1 } = this.box, { panel } = panelAt(start.y), tall = heights(start, now, panel);
      const [top, bottom] = tall || [y0, y1];
      this.over.innerHTML = `<rect class="chosen" x="${Math.min(start.x, now.x)}" y="${top}" width="${Math.abs(now.x - start.x)}" height="${bottom - top}"/>`;
    });
    svg.addEventListener("pointerup", (event) => {
      if (!start) return;
      const from = start, now = where(event);
      start = null;
      if (Math.abs(now.x - from.x) < DRAG) return this.cursor(this.fromX(now.x));
      const x = [from.x, now.x].sort((a, b) => a - b).map(this.fromX);
      const { panel, index } = panelAt(from.y), tall = heights(from, now, panel);
      if (tall) this.zoomTo(x, tall.reverse().map(panel.fromY), index);
      else this.zoomAlong(x);
    });
    svg.addEventListener("pointercancel", () => { start = null; this.over.innerHTML = ""; });
    svg.addEventListener("pointerleave", () => { if (!start && this.box) this.cursor(null); });
    svg.addEventListener("dblclick", () => this.zoomTo(null));
    svg.addEventListener("keydown", (event) => this.key(event));
  }

  // arrows move the cursor, with shift the view; + and − zoom about the cursor; 0 shows all
  key(event) {
    if (!this.box) return;
    const [low, high] = this.range(), span = high - low;
    const middle = this.at ?? (low + high) / 2;
    const sign = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (sign && event.shiftKey) this.zoomAlong([low + sign * span * 0.1, high + sign * span * 0.1]);
    else if (sign) this.cursor(Math.min(high, Math.max(low, middle + sign * Math.max(span / 100, this.spec.stride || 0))));
    else if (event.key === "+" || event.key === "=") this.zoomAlong([middle - span / 4, middle + span / 4]);
    else if (event.key === "-") this.zoomAlong([middle - span, middle + span]);
    else if (event.key === "0" || event.key === "Escape") this.zoomTo(null);
    else return;
    event.preventDefault();
  }
}
