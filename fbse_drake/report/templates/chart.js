// Draws the charts of a report with Plotly, which the page holds packed.
const packed = atob(document.getElementById("plotly").textContent);
const bytes = Uint8Array.from(packed, letter => letter.charCodeAt(0));
const unpacked = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
new Response(unpacked).text().then(source => {
  const library = document.createElement("script");
  library.textContent = source;
  document.head.append(library);
  document.querySelectorAll(".chart").forEach(chart => {
    const views = JSON.parse(chart.querySelector("script").textContent);
    const [select, plot] = [chart.querySelector("select"), chart.querySelector(".plot")];
    select.replaceChildren(...views.map(view => new Option(view.name)));
    const show = () => {
      const {data, layout} = views[select.selectedIndex];
      Plotly.react(plot, data, layout, {
        displaylogo: false, responsive: true,
        // Others would send the data away.
        modeBarButtons: [["zoom2d", "pan2d", "zoomIn2d", "zoomOut2d", "resetScale2d", "toImage"]],
      });
    };
    select.addEventListener("change", show);
    show();
  });
});
