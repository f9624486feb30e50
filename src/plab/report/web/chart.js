// Curves with spreads, drawn as SVG.
function ticksOf(low, high, log) {
  if (!log) {
    const raw = (high - low) / 5 || 1, unit = 10 ** Math.floor(Math.log10(raw));
    const step = [1, 2, 5, 10].map((factor) => factor * unit).find((size) => size >= raw);
    const ticks = [];
    for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) ticks.push(k * step);
    return ticks;
  }
  const factors = high < 30 * low ? [1, 2, 5] : [1], ticks = [];
  for (let power = Math.floor(Math.log10(low)); power <= Math.log10(high); power++) for (const f of factors) ticks.push(f * 10 ** power);
  return ticks.filter((value) => value >= low * 0.999 && value <= high * 1.001);
}
const short = (value) => {
  const size = Math.abs(value), sign = value < 0 ? "−" : "";
  if (size >= 1e6) return `${sign}${+(size / 1e6).toPrecision(3)}M`;
  return sign + (size >= 1e4 ? `${+(size / 1e3).toPrecision(3)}k` : String(+size.toPrecision(3)));
};


/**
 * Draw curves, each with x, y, low and high, into an SVG, and show their values at the pointer.
 * look: log (of x), bottom and top (of y, optional), label (of x), side (label of y), heading (of the tip, from x).
 */
function drawCurves(svg, tip, curves, look) {
  const { width, height } = svg.getBoundingClientRect(), { log } = look;
  tip.hidden = true;
  if (width < 80) return;
  svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
  const room = { left: 62, right: 12, top: 8, bottom: 40 };
  const xs = curves.flatMap(({ x }) => x).filter((x) => !log || x > 0);
  if (!xs.length) { svg.replaceChildren(make("text", { x: width / 2, y: height / 2, "text-anchor": "middle" }, "no data")); return; }
  const [x0, x1] = [Math.min(...xs), Math.max(...xs)];
  const y0 = look.bottom ?? Math.min(...curves.flatMap(({ low }) => low)), y1 = look.top ?? Math.max(...curves.flatMap(({ high }) => high), y0 + 1e-6);
  const scaled = (x) => (log ? Math.log(x / x0) / Math.log(x1 / x0 || 1) : (x - x0) / (x1 - x0)) || 0;
  const X = (x) => room.left + scaled(x) * (width - room.left - room.right);
  const Y = (y) => height - room.bottom - ((Math.min(Math.max(y, y0), y1) - y0) / (y1 - y0)) * (height - room.top - room.bottom);
  const parts = [];
  for (const y of ticksOf(y0, y1, false)) {
    parts.push(make("line", { class: "grid", x1: room.left, x2: width - room.right, y1: Y(y), y2: Y(y) }));
    parts.push(make("text", { x: room.left - 8, y: Y(y) + 4, "text-anchor": "end" }, short(y)));
  }
  for (const x of ticksOf(x0, x1, log)) {
    parts.push(make("line", { class: "grid", x1: X(x), x2: X(x), y1: room.top, y2: height - room.bottom }));
    parts.push(make("text", { x: X(x), y: height - room.bottom + 16, "text-anchor": "middle" }, short(x)));
  }
  parts.push(make("text", { x: (room.left + width - room.right) / 2, y: height - 6, "text-anchor": "middle" }, look.label));
  const middle = (room.top + height - room.bottom) / 2;
  parts.push(make("text", { x: 14, y: middle, "text-anchor": "middle", transform: `rotate(-90 14 ${middle})` }, look.side));
  for (const { name, dashes, x, y, low, high } of curves) {
    const at = x.map((value, k) => k).filter((k) => !log || x[k] > 0);
    const path = (values) => at.map((k) => `${X(x[k]).toFixed(1)} ${Y(values[k]).toFixed(1)}`);
    parts.push(make("path", { d: `M${[...path(high), ...path(low).reverse()].join("L")}Z`, fill: colour(name), "fill-opacity": 0.14 }));
    parts.push(make("path", { class: "mean", d: `M${path(y).join("L")}`, stroke: colour(name), "stroke-dasharray": dashes }));
  }
  const cursor = make("line", { class: "cursor", y1: room.top, y2: height - room.bottom, visibility: "hidden" });
  svg.replaceChildren(...parts, cursor);
  svg.onpointerleave = () => { tip.hidden = true; cursor.setAttribute("visibility", "hidden"); };
  svg.onpointermove = (event) => {
    const box = svg.getBoundingClientRect();
    const part = Math.min(Math.max((event.clientX - box.left - room.left) / (width - room.left - room.right), 0), 1);
    const at = log ? x0 * (x1 / x0) ** part : x0 + part * (x1 - x0);
    cursor.setAttribute("x1", X(at)); cursor.setAttribute("x2", X(at)); cursor.setAttribute("visibility", "visible");
    const rows = curves.map(({ name, label, x, y }) => {
      const k = x.reduce((best, value, here) => (Math.abs(value - at) < Math.abs(x[best] - at) ? here : best), 0);
      return make("div", {}, make("span", { class: "swatch", style: own(name) }), label, make("b", {}, short(y[k])));
    });
    tip.replaceChildren(make("div", {}, look.heading(at)), ...rows);
    tip.hidden = false;
    const left = 16 + X(at) + 14, wide = tip.offsetWidth;
    tip.style.left = `${Math.max(left + wide > width ? X(at) - wide : left, 4)}px`; tip.style.top = "3.6rem";
  };
}

/** Create a legend whose entries hide and show methods; hidden is a set of names. */
function legendOf(shown, hidden, redraw) {
  return make("div", { class: "legend" }, ...shown.map(({ name, label, dashes }) => {
    const stroke = make("path", { d: "M0 5H30", stroke: colour(name), "stroke-width": 2.5, "stroke-dasharray": dashes });
    const button = make("button", { type: "button", "aria-pressed": !hidden.has(name) }, make("svg", { viewBox: "0 0 30 10", "aria-hidden": "true" }, stroke), label);
    button.addEventListener("click", () => {
      if (!hidden.delete(name)) hidden.add(name);
      button.setAttribute("aria-pressed", !hidden.has(name));
      redraw();
    });
    return button;
  }));
}

/** Create a box with a legend and curves; curves() returns the visible curves, look() their style. Returns the box and a function that redraws it. */
function chartBox(label, shown, hidden, curves, look) {
  const svg = make("svg", { role: "img", "aria-label": label }), tip = make("div", { class: "tip", hidden: "" });
  const draw = () => drawCurves(svg, tip, curves(shown.filter(({ name }) => !hidden.has(name))), look());
  const box = make("div", { class: "chart" }, legendOf(shown, hidden, draw), make("div", { class: "plot" }, svg), tip);
  new ResizeObserver(draw).observe(svg);
  return [box, draw];
}
