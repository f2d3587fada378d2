// Mount each view that has data; open what is folded while the page is printed.
const MOUNTS = { distributions: mountDistributions, slices: mountSuperpulses, pulses: mountPulses, scatter: mountScatter };
for (const [name, mount] of Object.entries(MOUNTS)) {
  const host = document.getElementById(`view-${name}`);
  if (host && DATA[name]) mount(host, DATA[name]);
}

let folded = [];
addEventListener("beforeprint", () => {
  folded = [...document.querySelectorAll("details:not([open])")];
  folded.forEach((details) => { details.open = true; });
});
addEventListener("afterprint", () => folded.forEach((details) => { details.open = false; }));
