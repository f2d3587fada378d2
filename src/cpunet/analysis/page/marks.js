// What a panel can hold. Each series knows how to draw itself and which y it covers.
const px = (v) => v.toFixed(1);

const named = (s) => (s.name ? `class="${s.name}" ` : "");

function look(s) {
  const dash = s.dashed ? " stroke-dasharray=\"5 3\"" : "";
  return `${named(s)}stroke="${s.colour}" stroke-width="${s.width || 1.6}"${dash} fill="none"`;
}

function path(xs, ys, toX, toY) {
  let out = "", pen = "M";
  for (let i = 0; i < xs.length; i++) {
    if (!Number.isFinite(ys[i])) { pen = "M"; continue; }
    out += `${pen}${px(toX(xs[i]))} ${px(toY(ys[i]))}`;
    pen = "L";
  }
  return out;
}

const MARKS = {
  line: (s, toX, toY) => `<path ${look(s)} stroke-linejoin="round" opacity="${s.opacity || 1}" d="${path(s.xs, s.ys, toX, toY)}"/>`,
  band: (s, toX, toY) => {
    const known = s.xs.map((x, i) => i).filter((i) => Number.isFinite(s.low[i]) && Number.isFinite(s.high[i]));
    if (!known.length) return "";
    const side = (ys, order) => order.map((i) => `${px(toX(s.xs[i]))} ${px(toY(ys[i]))}`).join("L");
    return `<path ${named(s)}fill="${s.colour}" fill-opacity="${s.opacity || 0.18}" d="M${side(s.high, known)}L${side(s.low, [...known].reverse())}Z"/>`;
  },
  steps: (s, toX, toY) => {
    const base = px(toY(0));
    let line = "";
    s.ys.forEach((y, i) => { line += `V${px(toY(y))}H${px(toX(s.edges[i + 1]))}`; });
    const d = `M${px(toX(s.edges[0]))} ${base}${line}V${base}`;
    return (s.filled ? `<path fill="${s.colour}" fill-opacity="0.2" d="${d}Z"/>` : "") + `<path ${look(s)} d="${d}"/>`;
  },
  errors: (s, toX, toY) => `<path ${look({ ...s, width: 1 })} d="${s.xs
    .map((x, i) => (s.high[i] > s.low[i] ? `M${px(toX(x))} ${px(toY(s.low[i]))}V${px(toY(s.high[i]))}` : "")).join("")}"/>`,
  // dots as strokes of no length: one element for a whole cloud
  dots: (s, toX, toY) => {
    let d = "";
    for (let i = 0; i < s.xs.length; i++) {
      if (Number.isFinite(s.ys[i])) d += `M${px(toX(s.xs[i]))} ${px(toY(s.ys[i]))}h0`;
    }
    return `<path stroke="${s.colour}" stroke-width="${s.width || 3}" stroke-linecap="round" opacity="${s.opacity || 1}" fill="none" d="${d}"/>`;
  },
  // a vertical line at x
  mark: (s, toX) => `<path class="mark" d="M${px(toX(s.x))} 0V2000"/>`,
  note: (s, toX) => `<text class="note" style="fill: ${s.colour}" x="${px(toX(s.x) + s.shift)}" y="${s.y}" text-anchor="${s.anchor}">${escapeHtml(s.text)}</text>`,
};

function within(xs, ...columns) {
  return (from, to, take) => {
    for (let i = 0; i < xs.length; i++) {
      if (xs[i] < from || xs[i] > to) continue;
      for (const ys of columns) if (Number.isFinite(ys[i])) take(ys[i]);
    }
  };
}

const nothing = () => {};
const line = (xs, ys, rest) => ({ kind: "line", xs, ys, extent: within(xs, ys), ...rest });
const dots = (xs, ys, rest) => ({ kind: "dots", xs, ys, extent: within(xs, ys), ...rest });
const band = (xs, low, high, rest) => ({ kind: "band", xs, low, high, extent: within(xs, low, high), ...rest });
const errors = (xs, low, high, rest) => ({ kind: "errors", xs, low, high, extent: within(xs, low, high), ...rest });
const mark = (x) => ({ kind: "mark", x, extent: nothing });
const note = (x, y, text, rest) => ({ kind: "note", x, y, text, extent: nothing, ...rest });

// outer: the first and the last bar hold what lies outside, and do not set the height
function steps(edges, ys, rest) {
  return {
    kind: "steps", edges, ys, ...rest,
    extent: (from, to, take) => ys.forEach((y, i) => {
      const outer = rest.outer && (i === 0 || i === ys.length - 1);
      if (!outer && edges[i + 1] > from && edges[i] < to) take(y);
    }),
  };
}
