// The cross-section of a crystal, coloured by a quantity of each place.
const GREY = "#c8c8c8", LITHIUM = "#e4e4e4";
const FRAME = { left: 44, right: 92, top: 8, bottom: 40 };
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

class Crystal {
  // choose(place) is called with the index of a place that is clicked or moved to
  constructor(host, choose) {
    this.host = host;
    this.choose = choose;
    this.listen();
    new ResizeObserver(() => {
      if (host.clientWidth !== this.width) requestAnimationFrame(() => this.draw());
    }).observe(host);
  }

  // values of all places, null where there is none, and what they are
  show(values, label) {
    this.values = values;
    this.label = label;
    this.draw();
  }

  draw() {
    const { radius, length } = DATA.outline;
    this.width = this.host.clientWidth || 380;
    const across = this.width - FRAME.left - FRAME.right, tallest = Math.max(300, Math.min(620, 1.5 * this.width));
    const scale = this.scale = Math.min(across / radius, (tallest - FRAME.top - FRAME.bottom) / length);
    const w = radius * scale, h = length * scale;
    this.toX = (r) => FRAME.left + r * scale;
    this.toY = (z) => FRAME.top + h - z * scale;
    const trace = (lines) => (lines || []).map((line) => `M${line.map(([r, z]) => `${px(this.toX(r))} ${px(this.toY(z))}`).join("L")}Z`).join("");
    const outline = trace(DATA.outline.crystal), side = DATA.step_mm * scale, shade = this.shade();
    const cells = DATA.r_mm.map((r, i) => `<rect class="cell" x="${px(this.toX(r) - side / 2)}" y="${px(this.toY(DATA.z_mm[i]) - side / 2)}" ` +
      `width="${(side + 0.3).toFixed(2)}" height="${(side + 0.3).toFixed(2)}" fill="${shade.of(this.values[i])}"/>`);
    this.host.innerHTML = `<svg class="crystal" viewBox="0 0 ${this.width} ${h + FRAME.top + FRAME.bottom}" role="img"><title>Cross-section of the crystal</title>` +
      `<clipPath id="inside"><path d="${outline}" clip-rule="evenodd"/></clipPath>` +
      `<g clip-path="url(#inside)" shape-rendering="crispEdges"><path d="${outline}" fill="${LITHIUM}"/>${cells.join("")}</g>` +
      `<path d="${trace(DATA.outline.active)}" fill="none" stroke="#fff" stroke-opacity="0.8"/>` +
      `<path d="${trace(DATA.outline.contact)}" fill="${DATA.contact}"/><path d="${outline}" fill="none" stroke="#000" stroke-width="1.2"/>` +
      this.axes(w, h) + shade.bar(FRAME.left + w + 16, h) +
      "<g class=\"here\" fill=\"none\"><circle r=\"6\" stroke=\"#000\" stroke-width=\"4\"/><circle r=\"6\" stroke=\"#fff\" stroke-width=\"2\"/></g></svg>";
    this.mark();
  }

  axes(w, h) {
    const r = ticks([0, DATA.outline.radius], Math.max(1, w / 55)), z = ticks([0, DATA.outline.length], Math.max(1, h / 45));
    const bottom = FRAME.top + h;
    const below = r.at.map((v) => `<path class="frame" d="M${px(this.toX(v))} ${bottom + 2}v4"/><text x="${px(this.toX(v))}" y="${bottom + 19}" text-anchor="middle">${formatted(v, r.step)}</text>`);
    const beside = z.at.map((v) => `<path class="frame" d="M${FRAME.left - 6} ${px(this.toY(v))}h4"/><text x="${FRAME.left - 9}" y="${px(this.toY(v) + 4)}" text-anchor="end">${formatted(v, z.step)}</text>`);
    return below.join("") + beside.join("") + `<text x="${FRAME.left + w / 2}" y="${bottom + 35}" text-anchor="middle">r [mm]</text>` + upright(12, FRAME.top + h / 2, "z [mm]");
  }

  // colours of values, and the bar that explains them
  shade() {
    const known = this.values.filter((v) => v !== null), last = DATA.map.length - 1;
    let [low, high] = known.length ? [Math.min(...known), Math.max(...known)] : [0, 1];
    if (high <= low) [low, high] = [low - 0.5, high + 0.5];
    const bar = (x, h) => {
      const marks = ticks([low, high], Math.max(2, h / 50)), texts = marks.at.map((v) => formatted(v, marks.step));
      const widest = Math.max(0, ...texts.map((text) => text.length));
      return `<linearGradient id="shade" x1="0" x2="0" y1="1" y2="0">${DATA.map.map((colour, i) => `<stop offset="${(i / last).toFixed(4)}" stop-color="${colour}"/>`).join("")}</linearGradient>` +
        `<rect x="${x}" y="${FRAME.top}" width="12" height="${h}" fill="url(#shade)"/>` +
        marks.at.map((v, i) => {
          const y = FRAME.top + h * (1 - (v - low) / (high - low));
          return `<path class="frame" d="M${x + 12} ${px(y)}h3"/><text x="${x + 17}" y="${px(y + 4)}">${texts[i]}</text>`;
        }).join("") + upright(x + 32 + 7 * widest, FRAME.top + h / 2, this.label);
    };
    return { of: (v) => (v === null ? GREY : DATA.map[Math.round(((v - low) / (high - low)) * last)]), bar };
  }

  place(index) {
    this.chosen = index;
    this.mark();
  }

  mark() {
    const at = `translate(${px(this.toX(DATA.r_mm[this.chosen]))} ${px(this.toY(DATA.z_mm[this.chosen]))})`;
    this.host.querySelector(".here").setAttribute("transform", at);
  }

  listen() {
    let held = false;
    const at = (event) => {
      const svg = this.host.firstChild, frame = svg.getBoundingClientRect(), zoom = svg.viewBox.baseVal.width / frame.width;
      const r = ((event.clientX - frame.left) * zoom - this.toX(0)) / this.scale, z = (this.toY(0) - (event.clientY - frame.top) * zoom) / this.scale;
      const margin = 2 * DATA.step_mm, { radius, length } = DATA.outline;
      if (r < -margin || z < -margin || r > radius + margin || z > length + margin) return;
      this.choose(nearestPlace(r, z, DATA.row.keys()));
    };
    this.host.addEventListener("pointerdown", (event) => { held = true; at(event); });
    this.host.addEventListener("pointermove", (event) => { if (held) at(event); });
    for (const end of ["pointerup", "pointercancel"]) addEventListener(end, () => { held = false; });
    this.host.addEventListener("keydown", (event) => this.key(event));
  }

  // the next place on the same line, across bore and ditch
  key(event) {
    const way = ARROWS[event.key];
    if (!way || event.altKey || event.ctrlKey || event.metaKey) return;
    event.preventDefault();
    const ahead = withPulse.map((i) => {
      const dr = DATA.r_mm[i] - DATA.r_mm[this.chosen], dz = DATA.z_mm[i] - DATA.z_mm[this.chosen];
      return { i, along: dr * way[0] + dz * way[1], off: Math.abs(dr * way[1]) + Math.abs(dz * way[0]) };
    }).filter((p) => p.along > 0.5 * DATA.step_mm && p.off < 0.5 * DATA.step_mm);
    if (ahead.length) this.choose(ahead.reduce((a, b) => (b.along < a.along ? b : a)).i);
  }
}

const upright = (x, y, text) => `<text transform="translate(${x} ${y}) rotate(-90)" text-anchor="middle">${escapeHtml(text)}</text>`;
const withPulse = DATA.row.map((row, i) => i).filter((i) => DATA.row[i] >= 0);

function nearestPlace(r, z, among) {
  const away = (i) => Math.hypot(DATA.r_mm[i] - r, DATA.z_mm[i] - z);
  return [...among].reduce((a, b) => (away(b) < away(a) ? b : a));
}
