// Plots are as wide as the window they were drawn in: on paper each is scaled to the page.
const PAPER = 700; // px between the margins of A4
addEventListener("beforeprint", () => {
  for (const plot of document.querySelectorAll(".plot")) {
    const width = plot.offsetWidth;
    if (width <= PAPER) continue;
    plot.style.width = `${width}px`;
    plot.style.zoom = PAPER / width;
  }
});
addEventListener("afterprint", () => {
  for (const plot of document.querySelectorAll(".plot")) {
    plot.style.removeProperty("width");
    plot.style.removeProperty("zoom");
  }
});
