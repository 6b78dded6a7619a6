"use strict";
// Draws the curves of the report, and writes its CSV, from the page's one block of data. Nothing is loaded.
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const EDGE = { left: 58, right: 14, top: 24, bottom: 42 };
  const BANDED = 3; // runs that have a band: that of two is 12.7 standard errors wide
  const DRAGGED = 8; // pixels that make a drag of a click
  const BOX = 24; // pixels of height that make a drag a box: a flatter one zooms in on steps alone

  function make(name, attributes = {}, children = [], space = null) {
    const node = space ? document.createElementNS(space, name) : document.createElement(name);
    for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
    node.append(...[children].flat());
    return node;
  }

  const digitsOf = (step) => Math.min(20, Math.max(0, -Math.floor(Math.log10(step) + 1e-9)));
  const number = (value, least, most = least) =>
    value.toLocaleString("en-US", { minimumFractionDigits: least, maximumFractionDigits: most });

  // As the tables have it: no digits from 100 on, one below.
  function figureText(mean, half) {
    const digits = Math.abs(mean) >= 100 ? 0 : 1;
    return number(mean, digits) + (half === undefined ? "" : ` ± ${number(half, digits)}`);
  }

  function stepsText(value, step = 0) {
    const [unit, name] = value >= 1e6 ? [1e6, "M"] : value >= 1e3 ? [1e3, "k"] : [1, ""];
    return number(value / unit, 0, step ? digitsOf(step / unit) : 2) + name;
  }

  function ticks(low, high, most) {
    const rough = (high - low) / most, power = 10 ** Math.floor(Math.log10(rough));
    const step = [1, 2, 5, 10].map((m) => m * power).find((s) => s >= rough);
    const values = [];
    for (let n = Math.ceil(low / step - 1e-9); n * step <= high + 1e-9 * step; n++) values.push(n * step + 0); // no -0
    return { step, values };
  }

  // Not Math.min(...values): some browsers refuse as many arguments as there are points.
  const extent = (values) =>
    values.reduce(([low, high], value) => [Math.min(low, value), Math.max(high, value)], [Infinity, -Infinity]);
  const sorted = (a, b) => (a < b ? [a, b] : [b, a]);
  const clamped = (value, low, high) => Math.min(Math.max(value, low), high);

  // Places of a curve's points within [low, high] and of one on each side, so that lines go on to the edge.
  function inside(curve, [low, high]) {
    const at = curve.steps;
    return [...at.keys()].filter((i) => (at[i + 1] ?? at[i]) >= low && (at[i - 1] ?? at[i]) <= high);
  }

  const nearest = (curve, at) =>
    curve.steps.reduce((best, x, i) => (Math.abs(x - at) < Math.abs(curve.steps[best] - at) ? i : best), 0);

  class Chart {
    // `groups`: the methods of one task and budget; `figure`: an element with an empty svg and a caption.
    constructor(figure, groups) {
      this.svg = figure.querySelector("svg");
      this.groups = groups;
      const curve = ({ env_steps: steps = [], return_mean: mean = [] }) => ({ steps, mean });
      for (const group of groups) group.seeds = group.runs.map((n) => curve(data.runs[n].evaluations));
      this.whole = [0, Math.max(1, extent(groups.flatMap((group) => group.seeds.flatMap((seed) => seed.steps)))[1])];
      [this.x, this.y] = [this.whole, null]; // y is null where it is made to fit
      this.hidden = new Set();
      this.cursor = this.pointed = this.drag = this.marked = null;
      this.addControls(figure);
      this.addLegend(figure.querySelector("figcaption"));
      this.listenToPointer();
      this.svg.addEventListener("keydown", (event) => this.pressed(event));
      new ResizeObserver(() => this.draw()).observe(this.svg);
    }

    node(name, attributes, children) {
      return make(name, attributes, children, this.svg.namespaceURI);
    }

    addControls(figure) {
      const button = (text, press) => {
        const node = make("button", { type: "button" }, text);
        node.addEventListener("click", press);
        return node;
      };
      const box = (text, checked) => {
        const input = make("input", { type: "checkbox" });
        input.checked = checked;
        input.addEventListener("change", () => this.draw());
        controls.append(make("label", {}, [input, ` ${text}`]));
        return input;
      };
      this.tip = make("div", { class: "tip", hidden: "" });
      this.spoken = make("div", { class: "aside", "aria-live": "polite" });
      const plot = make("div", { class: "plot" }, [this.tip, this.spoken]);
      this.svg.replaceWith(plot);
      plot.prepend(this.svg);
      this.back = button("reset zoom", () => this.zoom(this.whole, null));
      const controls = make("div", { class: "controls" }, this.back);
      this.bands = box("95% intervals", true);
      this.seeds = box("single seeds", false);
      controls.append(button("show all", () => this.show(true)), button("hide all", () => this.show(false)));
      plot.after(controls);
    }

    addLegend(caption) {
      this.entries = this.groups.map((group) => {
        const line = { x1: 1, x2: 41, y1: 7, y2: 7, stroke: group.colour, "stroke-dasharray": group.dash };
        const sample = this.node("svg", { viewBox: "0 0 42 14", "aria-hidden": "true" }, this.node("line", line));
        const input = make("input", { type: "checkbox" }), value = make("span", { class: "value" });
        const told = `${group.label} (${group.n ? `n = ${group.n}` : "none finished"})`;
        const item = make("li", {}, [make("label", {}, [input, sample, make("span", {}, told)]), value]);
        input.checked = true;
        input.addEventListener("change", () => {
          this.hidden[input.checked ? "delete" : "add"](group);
          this.draw();
        });
        item.addEventListener("pointerenter", () => this.mark(group));
        item.addEventListener("pointerleave", () => this.mark(null));
        return { input, value, item };
      });
      caption.before(make("ul", { class: "legend" }, this.entries.map((entry) => entry.item)));
    }

    shown() {
      return this.groups.filter((group) => !this.hidden.has(group));
    }

    show(wanted) {
      this.hidden = new Set(wanted ? [] : this.groups);
      for (const entry of this.entries) entry.input.checked = wanted;
      this.draw();
    }

    mark(group) {
      this.marked = group;
      for (const node of this.svg.querySelectorAll("[data-group]"))
        node.classList.toggle("faded", group !== null && this.groups[node.dataset.group] !== group);
    }

    zoom(x, y) {
      [this.x, this.y] = [[Math.max(this.whole[0], x[0]), Math.min(this.whole[1], x[1])], y];
      this.draw();
    }

    // Of the runs, not of the bands: those of few runs can be many times as high as all curves.
    heights() {
      const curves = this.shown().flatMap((group) => [...group.seeds, group]);
      const [low, high] = extent(curves.flatMap((curve) => inside(curve, this.x).map((i) => curve.mean[i])));
      if (low > high) return [0, 1];
      const room = (high - low || Math.abs(high) || 1) * 0.04;
      return [low - room, high + room];
    }

    // Size in pixels, and the way from values to pixels of the plot and back.
    scales() {
      const { width, height } = this.svg.getBoundingClientRect();
      const w = Math.max(1, width - EDGE.left - EDGE.right), h = Math.max(1, height - EDGE.top - EDGE.bottom);
      const [x0, x1] = this.x, [y0, y1] = this.y ?? this.heights();
      return {
        width, height, w, h, y: [y0, y1],
        px: (value) => ((value - x0) / (x1 - x0)) * w,
        py: (value) => h - ((value - y0) / (y1 - y0)) * h,
        steps: (pixel) => x0 + ((pixel - EDGE.left) / w) * (x1 - x0),
        value: (pixel) => y0 + ((h - (pixel - EDGE.top)) / h) * (y1 - y0),
      };
    }

    draw() {
      const scale = this.scales();
      this.svg.setAttribute("viewBox", `0 0 ${scale.width} ${scale.height}`);
      // An inner svg cuts off what lies outside.
      const inner = { x: EDGE.left, y: EDGE.top, width: scale.w, height: scale.h };
      const curves = this.node("svg", inner, this.shown().map((group) => this.lines(group, scale)));
      this.svg.replaceChildren(this.axes(scale), curves, this.node("g", { class: "over" }));
      this.back.disabled = this.y === null && this.x[0] === this.whole[0] && this.x[1] === this.whole[1];
      this.mark(this.marked);
      this.point();
    }

    axes(scale) {
      const { w, h } = scale, layer = this.node("g", { transform: `translate(${EDGE.left} ${EDGE.top})` });
      const text = (x, y, anchor, said) => layer.append(this.node("text", { x, y, "text-anchor": anchor }, said));
      const line = (x1, x2, y1, y2) => layer.append(this.node("line", { class: "grid", x1, x2, y1, y2 }));
      const across = ticks(...scale.y, Math.max(2, h / 50)), along = ticks(...this.x, Math.max(2, w / 90));
      for (const value of across.values) {
        line(0, w, scale.py(value), scale.py(value));
        text(-8, scale.py(value) + 4, "end", number(value, digitsOf(across.step)));
      }
      for (const value of along.values) {
        line(scale.px(value), scale.px(value), 0, h);
        text(scale.px(value), h + 18, "middle", stepsText(value, along.step));
      }
      layer.append(this.node("path", { class: "axis", d: `M0 0V${h}H${w}`, fill: "none" }));
      text(4 - EDGE.left, -9, "start", "return");
      text(w, h + 36, "end", "environment steps");
      return layer;
    }

    // The band, the single seeds and the mean of one method.
    lines(group, scale) {
      const layer = this.node("g", { "data-group": this.groups.indexOf(group) });
      const points = (curve, values) =>
        inside(curve, this.x).map((i) => `${scale.px(curve.steps[i]).toFixed(1)} ${scale.py(values[i]).toFixed(1)}`);
      const path = (kind, parts, look) => {
        if (parts.length) layer.append(this.node("path", { class: kind, d: `M${parts.join("L")}`, ...look }));
      };
      if (this.bands.checked && group.n >= BANDED) {
        const edge = (sign) => points(group, group.mean.map((mean, i) => mean + sign * group.half_width[i]));
        path("band", [...edge(1), ...edge(-1).reverse()], { fill: group.colour });
      }
      if (this.seeds.checked || !group.n)
        for (const seed of group.seeds) path("seed", points(seed, seed.mean), { stroke: group.colour });
      path("mean", points(group, group.mean), { stroke: group.colour, "stroke-dasharray": group.dash });
      return layer;
    }

    // What the cursor is at: values in the legend, those of the nearest curve beside it; or what is being selected.
    point() {
      const over = this.svg.querySelector(".over"), scale = this.scales();
      over.replaceChildren();
      this.tip.hidden = true;
      for (const entry of this.entries) entry.value.textContent = "";
      if (this.drag?.to) return over.append(this.selection(scale));
      if (this.cursor === null) return;
      const x = EDGE.left + scale.px(this.cursor);
      over.append(this.node("line", { class: "cursor", x1: x, x2: x, y1: EDGE.top, y2: EDGE.top + scale.h }));
      let best = null;
      for (const group of this.shown().filter((each) => each.steps.length)) {
        const i = nearest(group, this.cursor), at = group.steps[i];
        const spot = { group, at, x: EDGE.left + scale.px(at), y: EDGE.top + scale.py(group.mean[i]) };
        spot.told = this.entries[this.groups.indexOf(group)].value.textContent =
          figureText(group.mean[i], group.half_width?.[i]);
        spot.far = this.pointed === null ? 0 : Math.abs(spot.y - this.pointed);
        if (best === null || spot.far < best.far) best = spot;
      }
      if (best === null || best.x < EDGE.left - 1 || best.x > EDGE.left + scale.w + 1) return;
      over.append(this.node("circle", { cx: best.x, cy: best.y, r: 4, fill: best.group.colour }));
      this.label(best, scale);
    }

    label(spot, scale) {
      const where = ` at ${stepsText(spot.at)} steps`, left = spot.x < EDGE.left + scale.w / 2;
      this.tip.replaceChildren(make("strong", {}, spot.told), where, make("br"), spot.group.label);
      this.tip.hidden = false;
      this.tip.style.left = left ? `${spot.x + 12}px` : "auto";
      this.tip.style.right = left ? "auto" : `${scale.width - spot.x + 12}px`;
      this.tip.style.top = `${clamped(spot.y - 20, 0, Math.max(0, scale.height - this.tip.offsetHeight))}px`;
    }

    selection(scale) {
      const { from, to } = this.drag, [left, right] = sorted(from.x, to.x), [top, bottom] = sorted(from.y, to.y);
      const tall = bottom - top < BOX ? { y: EDGE.top, height: scale.h } : { y: top, height: bottom - top };
      return this.node("rect", { class: "selection", x: left, width: right - left, ...tall });
    }

    listenToPointer() {
      const place = (event) => {
        const { left, top } = this.svg.getBoundingClientRect(), { w, h } = this.scales();
        const x = clamped(event.clientX - left, EDGE.left, EDGE.left + w);
        return { x, y: clamped(event.clientY - top, EDGE.top, EDGE.top + h) };
      };
      const on = (kind, does) => this.svg.addEventListener(kind, does);
      on("pointercancel", () => this.leave());
      on("dblclick", () => this.zoom(this.whole, null));
      on("pointerdown", (event) => {
        if (event.button !== 0 || !event.isPrimary) return;
        this.drag = { from: place(event), to: null };
        this.svg.setPointerCapture(event.pointerId);
      });
      on("pointermove", (event) => {
        const at = place(event);
        if (!this.drag) return this.moveTo(at);
        if (this.drag.to || Math.abs(at.x - this.drag.from.x) > DRAGGED) this.drag.to = at;
        this.point();
      });
      on("pointerup", (event) => {
        const drag = this.drag;
        this.drag = null;
        if (!drag?.to || Math.abs(drag.to.x - drag.from.x) <= DRAGGED) return this.moveTo(place(event));
        this.select(drag.from, drag.to);
      });
      on("pointerleave", (event) => event.pointerType === "mouse" && !this.drag && this.leave());
    }

    moveTo(at) {
      [this.cursor, this.pointed] = [this.scales().steps(at.x), at.y];
      this.point();
    }

    leave() {
      this.cursor = this.drag = null;
      this.point();
    }

    select(from, to) {
      const scale = this.scales(), flat = Math.abs(from.y - to.y) < BOX;
      this.cursor = null;
      const heights = flat ? null : sorted(scale.value(from.y), scale.value(to.y));
      this.zoom(sorted(scale.steps(from.x), scale.steps(to.x)), heights);
    }

    pressed(event) {
      const keys = {
        ArrowRight: () => this.step(1), ArrowLeft: () => this.step(-1),
        "+": () => this.closer(0.5), "=": () => this.closer(0.5), "-": () => this.closer(2),
        0: () => this.zoom(this.whole, null), Escape: () => this.leave(),
      };
      if (!keys[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
      event.preventDefault();
      keys[event.key]();
    }

    closer(times) {
      const [x0, x1] = this.x, middle = this.cursor ?? (x0 + x1) / 2, reach = ((x1 - x0) * times) / 2;
      this.zoom([middle - reach, middle + reach], null);
    }

    // To the next point of any curve, which is read out.
    step(sign) {
      const points = this.shown().flatMap((group) => group.steps).filter((at) => at >= this.x[0] && at <= this.x[1]);
      const ahead = points.filter((at) => this.cursor === null || sign * (at - this.cursor) > 0);
      if (!ahead.length) return;
      [this.cursor, this.pointed] = [extent(ahead)[sign > 0 ? 0 : 1], null];
      this.point();
      const told = this.groups.map((group, i) => `${group.label} ${this.entries[i].value.textContent}`);
      const read = told.filter((_, i) => this.entries[i].value.textContent);
      this.spoken.textContent = `At ${stepsText(this.cursor)} steps: ${read.join(", ")}`;
    }
  }

  function csv() {
    const cell = (value) => {
      const text = Array.isArray(value) ? value.join("; ") : String(value ?? "");
      return /[",\r\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
    };
    const lines = [[...data.said, ...data.columns]];
    for (const run of data.runs) {
      const said = data.said.map((name) => run[name]), columns = data.columns.map((name) => run.evaluations[name]);
      (columns[0] ?? []).forEach((_, i) => lines.push([...said, ...columns.map((column) => column[i])]));
    }
    return lines.map((line) => line.map(cell).join(",") + "\r\n").join("");
  }

  document.getElementById("csv").addEventListener("click", () => {
    const address = URL.createObjectURL(new Blob([csv()], { type: "text/csv" }));
    make("a", { href: address, download: "evaluations.csv" }).click();
    setTimeout(() => URL.revokeObjectURL(address), 1000);
  });
  for (const figure of document.querySelectorAll("[data-chart]")) new Chart(figure, data.charts[figure.dataset.chart]);
})();
