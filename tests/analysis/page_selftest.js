// Works the page as a user would, and tells the page around it what it saw.
(async () => {
  const seen = {};
  const refused = new Promise((done) => addEventListener("securitypolicyviolation", (e) => done(e.violatedDirective)));
  const host = (name) => document.getElementById(`view-${name}`);
  const svg = (name) => host(name).querySelector("svg.plot");
  const ticks = (name) => [...svg(name).querySelectorAll("text.tick[text-anchor=middle]")].map((t) => t.textContent);
  const strokes = (name, colour) => svg(name).querySelectorAll(`g[clip-path] [stroke="${colour}"]`).length;
  const cell = (name, key) => host(name).querySelector(`td[data-cell="${key}"]`).textContent;
  const pressed = (name) => host(name).querySelector("button[data-method=raw]").getAttribute("aria-pressed");
  const choose = (name, index, value) => {
    const select = host(name).querySelectorAll("select")[index];
    select.value = value;
    select.dispatchEvent(new Event("change"));
  };
  const point = (name, type, x, y = 0.3) => {
    const frame = svg(name).getBoundingClientRect();
    svg(name).dispatchEvent(new PointerEvent(type, {
      button: 0, pointerId: 1, bubbles: true,
      clientX: frame.left + x * frame.width, clientY: frame.top + y * frame.height,
    }));
  };
  const drag = (name, from, to, top = 0.3, bottom = 0.3) => {
    point(name, "pointerdown", from, top);
    point(name, "pointermove", (from + to) / 2, bottom);
    point(name, "pointerup", to, bottom);
  };
  const key = (name, value) => svg(name).dispatchEvent(new KeyboardEvent("keydown", { key: value }));
  const button = (name, title) => [...host(name).querySelectorAll(".controls button")].find((b) => b.textContent === title).click();
  const names = ["distributions", "slices", "pulses", "scatter"];
  await new Promise((done) => requestAnimationFrame(() => setTimeout(done, 50)));

  seen.labels = names.map((name) => [...svg(name).querySelectorAll("text.name")].map((t) => t.textContent));
  const raw = "#D55E00";
  const beside = () => [...host("scatter").querySelectorAll("button[data-method]")].map((b) => b.dataset.method);
  seen.beside = [beside()];
  choose("scatter", 1, "raw");
  seen.beside.push(beside());
  seen.rawBefore = names.map((name) => strokes(name, raw));
  host("slices").querySelector("button[data-method=raw]").click();
  seen.rawAfter = names.map((name) => strokes(name, raw));
  seen.pressed = names.map(pressed);
  host("scatter").querySelector("button[data-method=raw]").click();
  seen.rawAgain = names.map((name) => strokes(name, raw));

  seen.zoom = {};
  for (const name of names) {
    button(name, "All");
    const before = ticks(name);
    drag(name, 0.4, 0.6, 0.3, 0.5);
    const zoomed = ticks(name);
    const toggle = host(name).querySelector(`button[data-method=${name === "scatter" ? "raw" : "truth"}]`);
    toggle.click();
    toggle.click();
    const kept = ticks(name);
    svg(name).dispatchEvent(new MouseEvent("dblclick"));
    const back = ticks(name);
    key(name, "+");
    seen.zoom[name] = { before, zoomed, kept, back, plus: ticks(name) };
    key(name, "0");
  }
  button("slices", "All");
  seen.all = ticks("slices");
  button("slices", "Edge");
  seen.edge = ticks("slices");

  seen.below = cell("distributions", "data/below");
  seen.none = { data: null };
  seen.idle = getComputedStyle(host("distributions").querySelector("th.live")).visibility;
  choose("distributions", 1, "drift_time");
  seen.chosen = svg("distributions").querySelector("text.name:last-child").textContent;
  seen.none = cell("distributions", "data/none");
  point("distributions", "pointermove", 0.5);
  seen.hover = host("distributions").querySelector(".readout").textContent;
  seen.live = getComputedStyle(host("distributions").querySelector("th.live")).visibility;
  seen.bin = cell("distributions", "data/at");

  choose("slices", 1, "3");
  button("slices", "Edge");
  seen.lone = ticks("slices");
  button("slices", "All");
  // the cursor's first step is from the middle; the next ones are whole samples
  choose("slices", 1, "2");
  key("slices", "ArrowRight");
  seen.cursor = { time: host("slices").querySelector(".readout").textContent, height: cell("slices", "data/at") };

  const pulse = () => svg("pulses").querySelector("g[clip-path]").innerHTML;
  const first = pulse();
  const slider = host("pulses").querySelector("input[type=range]");
  slider.value = 3;
  slider.dispatchEvent(new Event("input"));
  seen.slider = { text: host("pulses").querySelector("output").textContent, moved: pulse() !== first };
  button("pulses", "›");
  seen.next = host("pulses").querySelector("output").textContent;

  choose("distributions", 0, "DEP");
  seen.gap = host("distributions").querySelector(".gap").textContent;
  seen.hidden = getComputedStyle(host("distributions").querySelector(".pair")).display;
  choose("distributions", 0, "SEP");
  seen.widths = [document.documentElement.scrollWidth, innerWidth, svg("distributions").clientWidth];
  // what a browser does to print: its rules for paper, and the event before and after
  const rules = [...document.styleSheets].flatMap((sheet) => [...sheet.cssRules]).filter((rule) => rule.media?.mediaText === "print");
  const folded = () => [...document.querySelectorAll("details")].map((d) => d.open);
  const before = folded();
  rules.forEach((rule) => { rule.media.mediaText = "all"; });
  dispatchEvent(new Event("beforeprint"));
  seen.printed = {
    before,
    open: folded(),
    hidden: [...document.querySelectorAll("nav, .controls, .readout, .screen")].map((e) => getComputedStyle(e).display),
    widths: [document.documentElement.scrollWidth, innerWidth, svg("distributions").clientWidth],
  };
  dispatchEvent(new Event("afterprint"));
  seen.printed.closed = folded();
  rules.forEach((rule) => { rule.media.mediaText = "print"; });
  document.querySelectorAll("details").forEach((d) => { d.open = true; });
  seen.unfolded = document.documentElement.scrollWidth;
  seen.resources = performance.getEntriesByType("resource").map((e) => e.name);
  seen.fetched = await fetch("http://localhost:9/").then(() => "allowed", () => "refused");
  seen.directive = await refused;
  seen.errors = window.caught;
  parent.postMessage(seen, "*");
})().catch((error) => parent.postMessage({ failed: `${error} ${error.stack}` }, "*"));
