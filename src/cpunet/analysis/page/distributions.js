// Histograms of a parameter in the bins that are scored, and the differences in sigma.
function mountDistributions(host, peaks) {
  const allColumns = [["iou", "IoU [%]"], ["n", "Pulses"], ["below", "Below"], ["above", "Above"], ["none", "No value"], ["at", "Bin"]];
  let counts = {}, edges = [];
  const view = new View(host, {
    title: "Distribution of a parameter by method; arrows move the cursor, plus and minus zoom, 0 shows all",
    onCursor: (x) => readout(x),
    look: (name) => (name === "data" ? { mark: "M1 10V2H21V10Z", width: 1, opacity: 1, fill: "#0003" } : {}),
  });
  const peak = view.select("Peak", peakChoices(peaks), update);
  const parameter = view.select("Parameter", [], update);
  view.button("All", () => view.plot.zoomTo(null), "Show the whole range");
  redraws.push(update);
  update();

  function current() {
    const found = peaks[peak.value];
    if (typeof found.missing === "string") return found;
    fill(parameter, Object.entries(found).map(([name, info]) => [name, info.label]));
    return found[parameter.value];
  }

  function update() {
    const found = current();
    parameter.disabled = typeof peaks[peak.value].missing === "string";
    if (view.missing(found.missing)) return;
    counts = found.counts;
    const names = inOrder(Object.keys(counts));
    const bins = counts.data.length - 3, width = (found.high - found.low) / bins;
    // one bar at either end for all that lies outside
    edges = Array.from({ length: bins + 3 }, (_, i) => found.low + (i - 1) * width);
    const undefinedOnes = names.some((name) => counts[name][counts[name].length - 1]);
    view.legend.build(names, allColumns.filter(([column]) => column !== "none" || undefinedOnes));
    names.forEach((name) => legendRow(name, found));
    const total = (name) => counts[name].reduce((a, b) => a + b, 0);
    const share = (name) => counts[name].slice(0, -1).map((c) => c / (total(name) || 1));
    const variance = (name) => counts[name].slice(0, -1).map((c) => c / (total(name) || 1) ** 2);
    const centres = edges.slice(1).map((e, i) => (e + edges[i]) / 2);
    const data = share("data"), dataVariance = variance("data");
    const upper = [mark(found.low), mark(found.high)], lower = [mark(found.low), mark(found.high)];
    for (const name of onTop(names.filter(isShown))) {
      const { colour, dashed } = methodOf(name), ys = share(name), spread = variance(name);
      upper.push(steps(edges, ys, { colour, dashed, outer: true, filled: name === "data", width: name === "data" ? 1 : 1.8 }));
      if (name === "data") {
        const error = spread.map(Math.sqrt);
        upper.push(errors(centres.slice(1, -1), ys.slice(1, -1).map((y, i) => y - error[i + 1]), ys.slice(1, -1).map((y, i) => y + error[i + 1]), { colour: "#555" }));
        continue;
      }
      const sigma = ys.map((y, i) => (spread[i] + dataVariance[i] > 0 ? (y - data[i]) / Math.sqrt(spread[i] + dataVariance[i]) : NaN));
      lower.push(dots(centres.slice(1, -1), sigma.slice(1, -1), { colour, width: 5, opacity: dashed ? 0.5 : 1, fit: name !== "raw" || names.filter(isShown).length < 3 }));
    }
    upper.push(...notes(names.filter(isShown), found, share));
    view.plot.show({
      key: `${peak.value}/${parameter.value}`,
      title: `${peak.value}: ${found.label}`,
      x: { label: withUnit(found), home: [edges[0], edges[edges.length - 1]] },
      stride: width,
      snap: (x) => centres[Math.min(centres.length - 1, Math.max(0, Math.floor((x - edges[0]) / width)))],
      panels: [
        { label: "Fraction per bin", share: 2, zero: true, series: upper },
        { label: "Pull [σ]", share: 1, symmetric: true, least: 3, series: lower },
      ],
    });
    readout(null);
  }

  // how much lies beyond the ends where the bar leaves the frame
  function notes(names, found, share) {
    const inner = names.flatMap((name) => share(name).slice(1, -1)), top = 1.06 * Math.max(...inner);
    return [[0, found.low, 6, "start"], [-1, found.high, -6, "end"]].flatMap(([bar, x, shift, anchor]) =>
      names.filter((name) => share(name).at(bar) > top).map((name, line) =>
        note(x, MARGIN.top + 12 + 14 * line, `${(100 * share(name).at(bar)).toFixed(0)} % beyond`, { colour: methodOf(name).colour, shift, anchor })));
  }

  function legendRow(name, found) {
    const all = counts[name], n = all.reduce((a, b) => a + b, 0), score = found.iou[name === "data" ? "ceiling" : name];
    const number = (v) => (v === null || v === undefined ? "–" : v.toFixed(1));
    const error = score && score[1] !== null && score[1] !== undefined ? ` ± ${number(score[1])}` : "";
    view.legend.set(name, "iou", score ? `${number(score[0])}${error}` : "–");
    [["n", n], ["below", all[0]], ["above", all[all.length - 2]], ["none", all[all.length - 1]]]
      .forEach(([column, value]) => view.legend.set(name, column, String(value)));
  }

  function readout(x) {
    const bin = x === null ? -1 : Math.floor((x - edges[0]) / (edges[1] - edges[0]) + 1e-6);
    for (const name of Object.keys(counts)) view.legend.set(name, "at", bin < 0 ? "" : String(counts[name][bin]));
    if (bin < 0) return view.say("Drag to zoom, double-click for all. The bars outside the dotted lines hold all pulses beyond them.");
    if (bin === 0) return view.say(`Below ${short(edges[1])}`);
    if (bin === edges.length - 2) return view.say(`Above ${short(edges[bin])}`);
    return view.say(`${short(edges[bin])} … ${short(edges[bin + 1])} ${peaks[peak.value][parameter.value].unit}`);
  }
}
