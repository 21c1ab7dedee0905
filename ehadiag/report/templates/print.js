// Plots are as wide as the window they were drawn in: on paper each is scaled to the page.
// The trend stays on the first page, all other plots together fit on one page, without their tools.
const PAPER = 700; // px between the margins of A4
const ROOM = { "#trend-part .plot": 88, ".response .plot": 840 }; // px of height
const toolbars = (visible) => {
  for (const root of globalThis.Bokeh?.documents ?? []) {
    for (const model of root._all_models.values()) if (model.type === "Toolbar") model.visible = visible;
  }
};
addEventListener("beforeprint", () => {
  toolbars(false);
  for (const [selector, room] of Object.entries(ROOM)) {
    const plots = [...document.querySelectorAll(selector)];
    const height = plots.reduce((sum, plot) => sum + (plot.offsetHeight * PAPER) / Math.max(plot.offsetWidth, PAPER), 0);
    const fit = Math.min(1, room / height);
    for (const plot of plots) {
      const width = plot.offsetWidth;
      plot.style.width = `${width}px`;
      plot.style.zoom = (fit * PAPER) / Math.max(width, PAPER);
    }
  }
});
addEventListener("afterprint", () => {
  toolbars(true);
  for (const plot of document.querySelectorAll(".plot")) {
    plot.style.removeProperty("width");
    plot.style.removeProperty("zoom");
  }
});
