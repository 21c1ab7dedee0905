// Plots are as wide as the window they were drawn in: on paper each is scaled to the page.
// All plots together fit on one page, without their tools.
const PAPER = 700; // px between the margins of A4
const PAGE = document.getElementById("trend-part") ? 560 : 800; // px of plots on their page
const toolbars = (visible) => {
  for (const root of globalThis.Bokeh?.documents ?? []) {
    for (const model of root._all_models.values()) if (model.type === "Toolbar") model.visible = visible;
  }
};
addEventListener("beforeprint", () => {
  toolbars(false);
  const plots = [...document.querySelectorAll(".plot")];
  const height = plots.reduce((sum, plot) => sum + (plot.offsetHeight * PAPER) / Math.max(plot.offsetWidth, PAPER), 0);
  const fit = Math.min(1, PAGE / height);
  for (const plot of plots) {
    const width = plot.offsetWidth;
    plot.style.width = `${width}px`;
    plot.style.zoom = (fit * PAPER) / Math.max(width, PAPER);
  }
});
addEventListener("afterprint", () => {
  toolbars(true);
  for (const plot of document.querySelectorAll(".plot")) {
    plot.style.removeProperty("width");
    plot.style.removeProperty("zoom");
  }
});
