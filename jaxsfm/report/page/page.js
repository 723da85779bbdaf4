"use strict";
// Draws every figure in the page's colours, one after another so that the page stays responsive.
(() => {
  const style = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

  function theme(layout) {
    const ink = style("--ink"), line = style("--line");
    const axes = (of) => {
      for (const key of Object.keys(of)) {
        if (/^[xyz]axis/.test(key)) {
          Object.assign(of[key], { gridcolor: line, zerolinecolor: line, linecolor: line, color: ink });
        }
      }
    };
    layout.paper_bgcolor = layout.plot_bgcolor = "rgba(0,0,0,0)";
    layout.font = { color: ink, size: 12, family: getComputedStyle(document.body).fontFamily };
    layout.modebar = { bgcolor: "rgba(0,0,0,0)", color: style("--soft"), activecolor: ink };
    layout.legend = Object.assign({}, layout.legend, { bgcolor: "rgba(0,0,0,0)" });
    axes(layout);
    if (layout.scene) axes(layout.scene);
    return layout;
  }

  const config = (id) => ({
    responsive: true,
    displaylogo: false,
    // Plotly draws at twice the screen's pixels: four times the work without a graphics card.
    plotGlPixelRatio: Math.min(devicePixelRatio || 1, 2),
    displayModeBar: id === "model",
    modeBarButtons: [["resetCameraDefault3d", "toImage"]],
  });
  const figures = [...document.querySelectorAll("script[data-for]")].map((source) => ({
    at: document.getElementById(source.dataset.for),
    spec: JSON.parse(source.textContent),
  }));
  const state = document.documentElement.dataset;

  async function draw() {
    for (const { at, spec } of figures) {
      try {
        await Plotly.newPlot(at, spec.data, theme(spec.layout), config(at.id));
      } catch (error) {
        at.textContent = "This figure cannot be drawn here: " + error;
        console.error(error);
      }
      await new Promise((resolve) => setTimeout(resolve));
    }
    state.drawnAfterMs = Math.round(performance.now());
  }

  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    for (const { at } of figures) if (at.layout) Plotly.relayout(at, theme(at.layout));
  });
  // Texts and photos first: they should not wait for the figures.
  requestAnimationFrame(() => setTimeout(draw));
})();
