"use strict";
// Draws what the page holds: figures as plotly specifications, and the trajectories to choose from.
pace.ready.then(() => {
  const CONFIG = {
    responsive: true, displaylogo: false, doubleClick: "reset", toImageButtonOptions: { scale: 2 },
    modeBarButtons: [["toImage"], ["zoom2d", "pan2d"], ["resetScale2d"]],
  };
  const read = (element) => JSON.parse(element.querySelector('script[type="application/json"]').textContent);
  const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

  /** A copy in which every "var(--name)" is the style sheet's present colour. */
  function inColor(value) {
    if (typeof value === "string") {
      const name = /^var\((--[a-z]+)\)$/.exec(value);
      return name ? css(name[1]) : value;
    }
    if (Array.isArray(value)) return value.map(inColor);
    if (value === null || typeof value !== "object" || ArrayBuffer.isView(value)) return value;
    return Object.fromEntries(Object.entries(value).map(([key, entry]) => [key, inColor(entry)]));
  }

  /** A layout in the page's look: every axis quiet, everything transparent. */
  function inStyle(layout) {
    const axis = { gridcolor: "var(--line)", zerolinecolor: "var(--line)", linecolor: "var(--line)", automargin: true };
    const result = {
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
      font: { family: getComputedStyle(document.body).fontFamily, size: 12.5, color: "var(--ink)" },
      legend: { orientation: "h", x: 0, y: 1.02, yanchor: "bottom" },
      hoverlabel: { bgcolor: "var(--card)", bordercolor: "var(--line)", font: { color: "var(--ink)" }, namelength: -1 },
      modebar: { bgcolor: "rgba(0,0,0,0)", color: "var(--target)", activecolor: "var(--ink)" },
      ...layout,
      margin: { l: 64, r: 16, t: 34, b: 44, ...layout.margin },
    };
    for (const name of new Set(["xaxis", "yaxis", ...Object.keys(layout).filter((key) => /^[xy]axis\d*$/.test(key))])) {
      result[name] = { ...axis, ...layout[name] };
      if (result[name].title) result[name].title = { font: { size: 13 }, standoff: 8, ...result[name].title };
    }
    return inColor(result);
  }

  /** The layout with panels below each other where the page is too narrow for them side by side. */
  function inWidth(layout, canvas) {
    const across = Object.keys(layout).filter((key) => /^xaxis\d*$/.test(key) && layout[key].domain);
    canvas.dataset.height ??= canvas.style.height;
    const narrow = across.length > 1 && document.documentElement.clientWidth < 640;
    canvas.style.height = narrow ? `${200 * across.length + 60}px` : canvas.dataset.height;
    if (!narrow) return layout;
    const below = Object.fromEntries(across.flatMap((key, i) => [
      [key, { ...layout[key], domain: [0, 1] }],
      [key.replace("x", "y"), { ...layout[key.replace("x", "y")], domain: [1 - (i + 0.62) / across.length, 1 - i / across.length] }],
    ]));
    return { ...layout, ...below };
  }

  /** A click on a head sorts the table's rows by that column, numbers by value; rows without a name stay last. */
  function makeSortable(table) {
    const body = table.tBodies[0], rows = [...body.rows];
    if (rows.length < 3) return;
    table.classList.add("can-sort");
    const key = (row, i) => {
      const text = row.cells[i].textContent.trim(), number = parseFloat(text.replace("−", "-"));
      return Number.isNaN(number) ? text : number;
    };
    [...table.tHead.rows[0].cells].forEach((head, i) => head.addEventListener("click", () => {
      const down = head.getAttribute("aria-sort") === "ascending";
      for (const other of table.tHead.rows[0].cells) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", down ? "descending" : "ascending");
      const order = (a, b) => (typeof a === typeof b ? (a > b) - (a < b) : typeof a === "number" ? -1 : 1) * (down ? -1 : 1);
      const named = rows.filter((row) => row.cells[0].textContent.trim());
      named.sort((a, b) => order(key(a, i), key(b, i)));
      body.append(...named, ...rows.filter((row) => !named.includes(row)));
    }));
  }

  function makeFigure(element) {
    const spec = read(element), canvas = element.querySelector(".canvas"), bar = element.querySelector(".views");
    let shown = spec.views[0];
    const update = (view) => {
      shown = view;
      for (const button of bar.children) button.setAttribute("aria-pressed", button.textContent === view.label);
      return Plotly.update(canvas, view.trace, view.layout);
    };
    for (const view of spec.views) {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = view.label;
      button.addEventListener("click", () => update(view));
      bar.append(button);
    }
    return async () => {
      await Plotly.react(canvas, inColor(spec.data), inStyle(spec.layout), CONFIG);
      if (shown) await update(shown);
    };
  }

  function makeExplorer(element) {
    const content = read(element), canvas = element.querySelector(".canvas");
    const chosen = (name) => Number(element.querySelector(`[data-choice="${name}"] input:checked`).value);
    const line = (name, x, y, color, more, rest) => ({
      type: "scatter", mode: "lines", name, x, y, line: { color, width: 1.5, ...more }, ...rest,
    });

    function draw() {
      const recording = content.recordings[chosen("recording")], curve = recording.joints[chosen("joint")];
      const time = pace.curve(recording.time);
      const x = curve.sample === null ? time : pace.curve(curve.sample).map((sample) => time[sample]);
      const shown = { hovertemplate: `%{y:.4f} ${curve.position_unit}` };
      const measured = pace.curve(curve.measured), error = pace.curve(curve.error);
      const data = [
        line("target", x, pace.curve(curve.target), "var(--target)", { width: 1.2 }, shown),
        line("measured", x, measured, "var(--measured)", { width: 2 }, shown),
        line("simulated", x, measured.map((value, i) => value + error[i]), "var(--simulated)", { dash: "5px,2px" }, shown),
        {
          ...line("error", x, error.map((value) => value * curve.factor), "var(--simulated)", { width: 1.1 }),
          yaxis: "y2", showlegend: false, hovertemplate: `%{y:.3g} ${curve.unit}`,
        },
      ];
      if (recording.held_out.length)
        data.push({
          type: "bar", x: [null], y: [null], name: "kept for validation", marker: { color: "var(--held)" }, hoverinfo: "skip",
        });
      const title = (text) => ({ text });
      const layout = {
        uirevision: `recording ${chosen("recording")}`,
        hovermode: "x unified", hoversubplots: "axis",
        xaxis: { title: title("time [s]"), anchor: "y2", range: [x[0], x[x.length - 1]] },
        yaxis: { title: title(`position [${curve.position_unit}]`), domain: [0.34, 1], uirevision: `joint ${chosen("joint")}` },
        yaxis2: {
          title: title(`error [${curve.unit}]`), domain: [0, 0.27], uirevision: `joint ${chosen("joint")}`,
          zerolinecolor: "var(--muted)",
        },
        shapes: recording.held_out.map(([x0, x1]) => ({
          type: "rect", xref: "x", yref: "paper", x0, x1, y0: 0, y1: 1, layer: "below", line: { width: 0 },
          fillcolor: "var(--held)",
        })),
      };
      element.querySelector(".errors-here").textContent = curve.text;
      return Plotly.react(canvas, inColor(data), inStyle(layout), CONFIG);
    }
    return drawnAt(element, content, draw);
  }

  /** Draw again where a choice changes, or a joint's name is clicked anywhere on the page. */
  function drawnAt(element, content, draw) {
    element.addEventListener("change", draw);
    document.addEventListener("click", (event) => {
      const joint = event.target.closest?.("[data-joint]")?.dataset.joint;
      const input = element.querySelector(`[data-choice="joint"] input[value="${content.joints.indexOf(joint)}"]`);
      if (!input) return;
      input.checked = true;
      draw();
    });
    return draw;
  }

  /** Figures of one joint and recording at a time: templates, which the chosen cell fills. */
  function makeChooser(element) {
    const content = read(element);
    const chosen = (name) => Number(element.querySelector(`[data-choice="${name}"] input:checked`).value);
    const merged = (base, more) => Object.fromEntries(
      [...new Set([...Object.keys(base), ...Object.keys(more)])].map((key) => [
        key, key in base && key in more && !Array.isArray(base[key]) && typeof base[key] === "object"
          ? { ...base[key], ...more[key] } : more[key] ?? base[key],
      ]));
    async function draw() {
      const cell = content.cells[chosen("recording")][chosen("joint")];
      for (const [name, figure] of Object.entries(content.figures)) {
        const card = element.querySelector(`[data-figure="${name}"]`), filled = cell[name];
        card.querySelector(".said").textContent = filled.text;
        const data = figure.traces.map((trace, i) => ({ ...trace, ...filled.traces[i] }));
        const canvas = card.querySelector(".canvas");
        await Plotly.react(
          canvas, inColor(data), inStyle(inWidth(merged(figure.layout, filled.layout), canvas)), CONFIG);
      }
    }
    return drawnAt(element, content, draw);
  }

  const drawers = [
    ...[...document.querySelectorAll(".explorer")].map(makeExplorer),
    ...[...document.querySelectorAll("figure.plot")].map(makeFigure),
    ...[...document.querySelectorAll(".chooser")].map(makeChooser),
  ];
  const drawAll = async () => {
    for (const draw of drawers) await draw();
    document.documentElement.dataset.drawn = "true";
  };
  document.querySelectorAll(".scroll table").forEach(makeSortable);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", drawAll);
  matchMedia("(max-width: 640px)").addEventListener("change", drawAll);
  drawAll();
});
