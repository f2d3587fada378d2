// Two parameters of single pulses.
const cloud = (name) => ({ ...(name === "data" ? { colour: "#888", opacity: 0.45, width: 4.2 } : { colour: methodOf(name).colour, opacity: 0.6, width: 2.6 }),
  mark: "M11 5h0", cap: "round", dashed: false });

function mountScatter(host, data) {
  const columns = [["n", "Pulses"], ["drawn", "Drawn"], ["inside", "In the frame"], ["none", "No value"]];
  let clouds = {};
  const view = new View(host, {
    title: "Current amplitude and drift time of single pulses by method",
    box: true,
    most: 560,
    look: cloud,
  });
  const peak = view.select("Peak", peakChoices(data.peaks), update);
  const beside = view.select("Beside the data", [], update);
  view.button("Data's range", () => view.plot.zoomTo(null), "Show where the data lie");
  view.button("All", () => {
    const all = (axis) => ends(Object.keys(clouds).filter(isShown).flatMap((name) => clouds[name][axis]));
    view.plot.zoomTo(all("x"), all("y"));
  }, "Show all pulses");
  const draw = view.plot.draw.bind(view.plot);
  view.plot.draw = () => { draw(); count(); };
  redraws.push(update);
  view.say("Drag a frame to zoom, double-click for the data’s range.");
  update();

  function ends(values) {
    const low = values.reduce((a, b) => Math.min(a, b), Infinity), high = values.reduce((a, b) => Math.max(a, b), -Infinity);
    const room = (high - low) * 0.04 || 1;
    return Number.isFinite(low) ? [low - room, high + room] : [0, 1];
  }

  function update() {
    const found = data.peaks[peak.value];
    if (view.missing(found.missing)) return;
    const all = inOrder(Object.keys(found.methods)), others = all.filter((name) => name !== "data");
    const first = beside.options.length === 0;
    fill(beside, others.map((name) => [name, methodOf(name).label]));
    if (first && others.includes("ren")) beside.value = "ren";
    const names = all.filter((name) => name === "data" || name === beside.value);
    view.legend.build(names, columns);
    clouds = {};
    for (const name of names) {
      const { n, missing, x, y } = found.methods[name];
      clouds[name] = { x: unpack(x), y: unpack(y) };
      view.legend.set(name, "n", String(n));
      view.legend.set(name, "drawn", String(clouds[name].x.length));
      view.legend.set(name, "none", String(missing));
    }
    view.plot.show({
      key: peak.value,
      title: `${peak.value}: single pulses`,
      x: { label: withUnit(data.axes[0]), home: found.home[0] },
      panels: [{
        label: withUnit(data.axes[1]),
        home: found.home[1],
        series: names.filter(isShown).map((name) => dots(clouds[name].x, clouds[name].y, cloud(name))),
      }],
    });
  }

  function count() {
    const found = data.peaks[peak.value];
    if (!view.plot.spec || found.missing) return;
    const [low, high] = view.plot.range(), y = (view.plot.zoom && view.plot.zoom.y) || found.home[1];
    for (const [name, cloud] of Object.entries(clouds)) {
      const inside = cloud.x.filter((v, i) => v >= low && v <= high && cloud.y[i] >= y[0] && cloud.y[i] <= y[1]).length;
      view.legend.set(name, "inside", `${inside} (${((100 * inside) / (cloud.x.length || 1)).toFixed(0)} %)`);
    }
  }
}
