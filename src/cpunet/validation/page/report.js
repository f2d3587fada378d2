// A click on a method in the legend hides or shows what all figures draw of it.
const hidden = document.head.appendChild(document.createElement("style"));
const buttons = [...document.querySelectorAll("button[data-hides]")];
const isShown = (button) => button.getAttribute("aria-pressed") === "true";
for (const button of buttons) {
  button.addEventListener("click", () => {
    button.setAttribute("aria-pressed", String(!isShown(button)));
    hidden.textContent = buttons.filter((one) => !isShown(one))
      .map((one) => `[data-method="${CSS.escape(one.dataset.hides)}"] { display: none; }`).join("\n");
  });
}

// what is folded is open while the page is printed
let folded = [];
addEventListener("beforeprint", () => {
  folded = [...document.querySelectorAll("details:not([open])")];
  folded.forEach((details) => { details.open = true; });
});
addEventListener("afterprint", () => folded.forEach((details) => { details.open = false; }));
