"use strict";
// The page of results. All numbers are in the element #content and, curves and runs, in data/<configuration>.js.
const plab = (() => {
  const content = JSON.parse(document.getElementById("content").textContent);
  const { methods, configurations } = content;
  const labels = {
    episodes: "episodes", seconds: "wall time [s], a run's share of its batch", substeps: "simulated substeps",
    reward: "reward", score: "score", iou: "soft IoU", loss: "loss",
  };
  const shortLabels = { ...labels, seconds: "wall time" };
  const find = (selector, within = document) => within.querySelector(selector);
  const all = (selector, within = document) => [...within.querySelectorAll(selector)];

  /** Make an element: text is never taken for HTML. */
  function make(name, attributes = {}, ...children) {
    const drawing = ["svg", "path", "line", "text", "g", "rect"].includes(name);
    const node = drawing ? document.createElementNS("http://www.w3.org/2000/svg", name) : document.createElement(name);
    for (const [key, value] of Object.entries(attributes)) if (value !== null) node.setAttribute(key, value);
    node.append(...children.filter((child) => child !== null));
    return node;
  }
  const fixed = (value, digits = 2) => (value === null ? "–" : (Math.abs(value) < 0.5 / 10 ** digits ? 0 : value).toFixed(digits));
  const signed = (value) => (value === null ? "–" : (value >= 0.005 ? "+" : value <= -0.005 ? "−" : "") + fixed(Math.abs(value)));
  const own = (name) => `--own: var(--${name})`;

  // --------------------------------------------------------------------------------------------- overview
  const state = { sort: "task", descending: false, form: "ours" };
  const runsOf = (one) => methods.reduce((sum, { name }) => sum + one.cells[name].ours.count, 0);
  let emptyColumns = new Set(); // without a number in any row: narrow windows leave them out
  const only = find("#only");
  only.checked = configurations.some(runsOf) && !configurations.every(runsOf);

  function cell(one, { name }) {
    const { ours, paper, difference } = one.cells[name];
    const shown = { ours, paper }[state.form];
    const lacking = emptyColumns.has(name) ? "empty" : "";
    const td = make("td", { class: "number value", style: own(name) });
    if (state.form === "difference") {
      const [value, low, high] = difference;
      if (value === null) return make("td", { class: `number none ${lacking}` }, "–");
      td.append(make("span", {}, make("b", {}, signed(value)), " ", make("small", {}, low === null ? "" : `[${signed(low)}, ${signed(high)}]`)));
      return td;
    }
    if (!shown.count) return make("td", { class: `number none ${lacking}` }, state.form === "ours" ? `0/${ours.expected}` : "–");
    td.style.setProperty("--part", Math.min(Math.max(shown.mean, 0), 1));
    const best = Math.max(...methods.map((each) => one.cells[each.name][state.form].mean ?? -1));
    if (shown.mean === best) td.classList.add("best");
    const spread = shown.count > 1 ? `± ${fixed(shown.std)}` : "";
    const short = state.form === "ours" && shown.count < ours.expected ? ` (${shown.count}/${ours.expected})` : "";
    td.append(make("span", {}, make("b", {}, fixed(shown.mean)), " ", make("small", {}, spread + short)));
    return td;
  }

  function sortKey(one, position) {
    if (state.sort === "task") return position;
    if (state.sort === "variant") return Number(one.variant) || 0;
    if (state.sort === "runs") return runsOf(one);
    const own = one.cells[state.sort];
    return state.form === "difference" ? own.difference[0] : own[state.form].mean;
  }

  function showOverview() {
    const words = find("#search").value.toLowerCase().split(/\s+/).filter(Boolean);
    const rows = configurations
      .map((one, position) => ({ one, key: sortKey(one, position) }))
      .filter(({ one }) => !only.checked || runsOf(one))
      .filter(({ one }) => words.every((word) => one.name.toLowerCase().includes(word)));
    // What has no number stays at the end, whichever way is up.
    rows.sort((a, b) => (a.key === null) - (b.key === null) || (state.descending ? b.key - a.key : a.key - b.key));
    const form = (one, name) => (state.form === "paper" ? one.cells[name].paper.count : one.cells[name].ours.count);
    emptyColumns = new Set(methods.map(({ name }) => name).filter((name) => !rows.some(({ one }) => form(one, name))));
    find("#configurations tbody").replaceChildren(...rows.map(({ one }) => {
      const expected = methods.reduce((sum, { name }) => sum + one.cells[name].ours.expected, 0);
      const row = make("tr", { "data-name": one.name, class: runsOf(one) ? "" : "without" },
        make("td", {}, make("a", { href: `#${one.name}` }, one.task)), make("td", { class: "number" }, one.variant),
        ...methods.map((each) => cell(one, each)), make("td", { class: "number" }, `${runsOf(one)}/${expected}`));
      row.addEventListener("click", () => { location.hash = one.name; });
      return row;
    }));
    for (const head of all("#configurations th")) {
      head.classList.toggle("empty", emptyColumns.has(head.dataset.sort));
      if (head.dataset.sort === state.sort) head.setAttribute("aria-sort", state.descending ? "descending" : "ascending");
      else head.removeAttribute("aria-sort");
    }
    find("#nothing").hidden = rows.length > 0;
    find("#count").value = `${rows.length} of ${configurations.length} configurations`;
  }

  for (const head of all("#configurations th")) {
    find("button", head).addEventListener("click", () => {
      const same = state.sort === head.dataset.sort;
      // Scores are looked at from the best downwards.
      state.descending = same ? !state.descending : !["task", "variant"].includes(head.dataset.sort);
      state.sort = head.dataset.sort;
      showOverview();
    });
  }
  find("#search").addEventListener("input", showOverview);
  only.addEventListener("change", showOverview);
  choose(find("#form"), (value) => { state.form = value; showOverview(); });

  /** Make a row of buttons a choice of one. */
  function choose(group, react) {
    for (const button of all("button", group)) {
      button.addEventListener("click", () => {
        for (const each of all("button", group)) each.setAttribute("aria-pressed", each === button);
        react(button.value);
      });
    }
  }

  // ---------------------------------------------------------------------------------------- configuration
  const received = new Map();

  /** Get a configuration's curves and runs: a script, for data may not be loaded from the file system. */
  function fetchDetails(name, react) {
    if (received.has(name)) { react(received.get(name)); return; }
    const script = make("script", { src: `data/${encodeURIComponent(name)}.js` });
    script.addEventListener("load", () => react(received.get(name)));
    script.addEventListener("error", () => react(null));
    document.head.append(script);
  }

  function showConfiguration(one) {
    const place = find("#configuration"), at = configurations.indexOf(one);
    const link = (other, text) => (other ? make("a", { href: `#${other.name}` }, text) : "");
    place.replaceChildren(
      make("nav", { class: "way" }, make("a", { href: "#" }, "← all configurations"), make("span"),
        link(configurations[at - 1], "previous"), link(configurations[at + 1], "next")),
      make("h1", {}, `${one.task}, variant ${one.variant}`));
    if (!runsOf(one)) {
      place.append(make("p", { class: "missing" }, "There are no finished runs of this configuration: ",
        make("code", {}, `python -m plab.run task=${one.task} variant=${one.variant}`), " makes one."));
      return;
    }
    place.append(pictures(one));
    fetchDetails(one.name, (details) => {
      if (location.hash !== `#${one.name}`) return;
      if (!details) { place.append(make("p", { class: "missing" }, `data/${one.name}.js is not there: make the page again.`)); return; }
      place.append(...films(one, details), ...chart(details), ...runTable(details));
    });
  }

  function pictures(one) {
    const made = ["start", "target"].filter((what) => one.pictures[what]);
    if (!made.length) {
      return make("p", { class: "missing" }, "No pictures yet: ", make("code", {}, "python -m plab.report html"), " draws them where there is OpenGL, with ", make("code", {}, "pip install 'plab[render]'"), ".");
    }
    return make("div", { class: "pictures" }, ...made.map((what) => make("figure", {},
      make("img", { src: one.pictures[what], alt: `${one.name}: ${what}`, width: 480, height: 360 }),
      make("figcaption", {}, make("b", {}, what), make("small", {}, what === "start" ? "with the target's ghost" : "as if it were plasticine")))));
  }

  function films(one, details) {
    const shown = methods.filter(({ name }) => details[name] && one.pictures[name]);
    if (!shown.length) return [];
    const figures = shown.map(({ name, label }) => {
      const { ours, paper } = one.cells[name], best = details[name].runs.find((run) => run.hash === details[name].best);
      const film = one.pictures[`${name} film`];
      const view = film
        ? make("video", { src: film, poster: one.pictures[name], loop: "", muted: "", playsinline: "", preload: "none", width: 480, height: 360, "aria-label": `${one.name}: rollout of ${label}` })
        : make("img", { src: one.pictures[name], alt: `${one.name}: end of ${label}`, width: 480, height: 360 });
      view.muted = true;
      const printed = paper.count ? `; paper ${fixed(paper.mean)} ± ${fixed(paper.std)}` : "";
      return make("figure", {}, view, film ? startButton(view, label) : null, make("figcaption", {}, make("span", { class: "swatch", style: own(name) }), make("b", {}, label),
        `score ${fixed(best.score)}, seed ${best.seed}`,
        make("small", {}, `all seeds ${fixed(ours.mean)}${ours.count > 1 ? ` ± ${fixed(ours.std)}` : ""} (${ours.count}/${ours.expected})${printed}`)));
    });
    const play = make("button", { type: "button", class: "play" }, "play all");
    const grid = make("div", { class: "pictures" }, ...figures);
    play.addEventListener("click", () => {
      const videos = all("video", grid), start = videos.some((video) => video.paused);
      for (const video of videos) { if (start) { video.currentTime = 0; video.play(); } else video.pause(); }
    });
    const head = make("div", { class: "heading" }, make("h2", {}, "The best run of each method"), all("video", grid).length ? play : "");
    return [head, grid, make("p", { class: "note" }, "Replayed in the hard contact model; pictures show the last state.")];
  }

  function startButton(video, label) {
    const button = make("button", { type: "button", class: "start", "aria-label": `play or stop the rollout of ${label}` });
    const turn = () => { if (video.paused) video.play(); else video.pause(); };
    for (const node of [button, video]) node.addEventListener("click", turn);
    for (const what of ["play", "pause"]) video.addEventListener(what, () => video.parentElement.classList.toggle("playing", !video.paused));
    return button;
  }

  function runTable(details) {
    const body = methods.filter(({ name }) => details[name]).flatMap(({ name, label }) => details[name].runs.map((run) => {
      const copy = make("button", { type: "button", class: "copy", title: run.command }, "copy command");
      copy.addEventListener("click", () => { navigator.clipboard?.writeText(run.command); copy.textContent = "copied"; });
      const time = `${fixed(run.seconds, 1)} s`, place = `${run.device}${run.batch > 1 ? `, ${run.batch} at once` : ""}`;
      const numbers = [run.seed, fixed(run.score, 3), fixed(run.iou, 3), run.loss === null ? "–" : run.loss.toPrecision(4), `${run.best_iteration} of ${run.iterations}`, time];
      return make("tr", {}, make("td", {}, make("span", { class: "swatch", style: own(name) }), ` ${label}`),
        ...numbers.map((text) => make("td", { class: "number" }, String(text))), make("td", {}, place),
        make("td", {}, make("code", { title: `${run.hash}\n${run.path}` }, run.hash.slice(0, 8))), make("td", {}, copy));
    }));
    const heads = ["method", "seed", "score", "soft IoU", "best loss", "best row", "time", "computed on", "SHA-256", ""];
    const head = make("tr", {}, ...heads.map((text, at) => make("th", { class: at > 0 && at < 7 ? "number" : "" }, text)));
    const runs = Object.values(details).flatMap((own) => own.runs), best = runs.reduce((a, b) => (b.score > a.score ? b : a));
    const commands = [best.command, `python -m plab.render ${best.path} --output rollout.mp4`].map((text) => make("code", {}, text));
    return [make("h2", {}, "Runs"), make("div", { class: "scroll" }, make("table", { class: "plain runs" }, make("thead", {}, head), make("tbody", {}, ...body))),
      make("p", { class: "note" }, "Times of runs that were computed at once are each one's share. The run with the highest score is made again, and drawn, by"), make("div", { class: "commands" }, ...commands)];
  }

  // ------------------------------------------------------------------------------------------------ curves
  const view = { column: "reward", axis: "episodes", scale: "log", hidden: new Set() };

  function chart(details) {
    const shown = methods.filter(({ name }) => details[name]);
    const group = (name, values, texts) => {
      const buttons = values.map((value) => make("button", { type: "button", value, "aria-pressed": view[name] === value }, texts[value] ?? value));
      const made = make("div", { class: "choice", role: "group", "aria-label": name }, ...buttons);
      choose(made, (value) => { view[name] = value; draw(); });
      return made;
    };
    const legend = make("div", { class: "legend" }, ...shown.map(({ name, label, dashes }) => {
      const stroke = make("path", { d: "M0 5H30", stroke: `var(--${name})`, "stroke-width": 2.5, "stroke-dasharray": dashes });
      const button = make("button", { type: "button", "aria-pressed": !view.hidden.has(name) }, make("svg", { viewBox: "0 0 30 10" }, stroke), label);
      button.addEventListener("click", () => {
        if (!view.hidden.delete(name)) view.hidden.add(name);
        button.setAttribute("aria-pressed", !view.hidden.has(name));
        draw();
      });
      return button;
    }));
    const svg = make("svg", { role: "img", "aria-label": "curves" }), tip = make("div", { class: "tip", hidden: "" });
    const box = make("div", { class: "chart" }, legend, svg, tip);
    const draw = () => drawChart(svg, tip, shown.filter(({ name }) => !view.hidden.has(name)), details);
    new ResizeObserver(draw).observe(svg);
    const head = make("div", { class: "heading" }, make("h2", {}, "Curves"), group("column", content.columns, shortLabels),
      group("axis", content.axes, shortLabels), group("scale", ["log", "linear"], {}));
    const note = "Lines: mean over the seeds; shaded: one standard deviation. Gradient methods are shown in the contact model of their rollouts (soft, but for Adam-H), RL in the hard one, so ends may differ from the scores above. Rewards and scores below zero count as zero, as in the paper.";
    return [head, box, make("p", { class: "note" }, note)];
  }

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
    const size = Math.abs(value);
    if (size >= 1e6) return `${+(value / 1e6).toPrecision(3)}M`;
    return size >= 1e4 ? `${+(value / 1e3).toPrecision(3)}k` : String(+value.toPrecision(3));
  };

  function drawChart(svg, tip, shown, details) {
    const { width, height } = svg.getBoundingClientRect();
    tip.hidden = true;
    if (width < 80) return;
    svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    const curves = shown.map((each) => ({ ...each, points: details[each.name].curves[view.column][view.axis] })).filter(({ points }) => points);
    const clamped = view.column !== "loss", log = view.scale === "log";
    const room = { left: 46, right: 12, top: 8, bottom: 40 };
    const xs = curves.flatMap(({ points }) => points[0]).filter((x) => !log || x > 0);
    const tops = curves.flatMap(({ points: [, mean, std] }) => mean.map((y, k) => y + std[k])), lows = curves.flatMap(({ points: [, mean, std] }) => mean.map((y, k) => y - std[k]));
    if (!xs.length) { svg.replaceChildren(make("text", { x: width / 2, y: height / 2, "text-anchor": "middle" }, "nothing to draw")); return; }
    const [x0, x1] = [Math.min(...xs), Math.max(...xs)];
    const bounded = ["score", "iou"].includes(view.column);
    const y0 = clamped ? 0 : Math.min(...lows), y1 = view.column === "score" ? 1 : Math.max(...tops, y0 + 1e-6);
    const scaled = (x) => (log ? Math.log(x / x0) / Math.log(x1 / x0 || 1) : (x - x0) / (x1 - x0)) || 0;
    const X = (x) => room.left + scaled(x) * (width - room.left - room.right);
    const Y = (y) => height - room.bottom - ((Math.max(y, y0) - y0) / (y1 - y0)) * (height - room.top - room.bottom);
    const parts = [];
    for (const y of ticksOf(y0, y1, false)) {
      parts.push(make("line", { class: "grid", x1: room.left, x2: width - room.right, y1: Y(y), y2: Y(y) }));
      parts.push(make("text", { x: room.left - 8, y: Y(y) + 4, "text-anchor": "end" }, short(y)));
    }
    for (const x of ticksOf(x0, x1, log)) {
      parts.push(make("line", { class: "grid", x1: X(x), x2: X(x), y1: room.top, y2: height - room.bottom }));
      parts.push(make("text", { x: X(x), y: height - room.bottom + 16, "text-anchor": "middle" }, short(x)));
    }
    parts.push(make("text", { x: (room.left + width - room.right) / 2, y: height - 6, "text-anchor": "middle" }, labels[view.axis]));
    const ceiling = bounded ? 1 : Infinity;
    for (const { name, dashes, points: [x, mean, std] } of curves) {
      const at = x.map((value, k) => k).filter((k) => !log || x[k] > 0);
      const path = (values) => values.map(([a, b]) => `${X(a).toFixed(1)} ${Y(b).toFixed(1)}`).join("L");
      const upper = at.map((k) => [x[k], Math.min(mean[k] + std[k], ceiling)]), lower = at.map((k) => [x[k], mean[k] - std[k]]).reverse();
      parts.push(make("path", { d: `M${path([...upper, ...lower])}Z`, fill: `var(--${name})`, "fill-opacity": 0.14 }));
      parts.push(make("path", { class: "mean", d: `M${path(at.map((k) => [x[k], mean[k]]))}`, stroke: `var(--${name})`, "stroke-dasharray": dashes }));
    }
    const cursor = make("line", { class: "cursor", y1: room.top, y2: height - room.bottom, visibility: "hidden" });
    svg.replaceChildren(...parts, cursor);
    svg.onpointerleave = () => { tip.hidden = true; cursor.setAttribute("visibility", "hidden"); };
    svg.onpointermove = (event) => {
      const part = Math.min(Math.max((event.offsetX - room.left) / (width - room.left - room.right), 0), 1);
      const x = log ? x0 * (x1 / x0) ** part : x0 + part * (x1 - x0);
      cursor.setAttribute("x1", X(x)); cursor.setAttribute("x2", X(x)); cursor.setAttribute("visibility", "visible");
      const rows = curves.map(({ name, label, points }) => {
        const k = points[0].reduce((best, value, at) => (Math.abs(value - x) < Math.abs(points[0][best] - x) ? at : best), 0);
        return make("div", {}, make("span", { class: "swatch", style: own(name) }), label, make("b", {}, String(+points[1][k].toPrecision(3))));
      });
      tip.replaceChildren(make("div", {}, `${view.axis === "episodes" ? Math.round(x) : short(x)} ${view.axis}`), ...rows);
      tip.hidden = false;
      const left = svg.offsetLeft ?? 0, wide = tip.offsetWidth;
      const spot = 16 + X(x) + 14 + wide > width ? X(x) - wide : 16 + X(x) + 14;
      tip.style.left = `${Math.max(spot + left, 4)}px`; tip.style.top = "3.6rem";
    };
  }

  // ----------------------------------------------------------------------------------------------- routing
  function route() {
    const one = configurations.find(({ name }) => `#${name}` === decodeURIComponent(location.hash));
    find("#overview").hidden = Boolean(one);
    find("#configuration").hidden = !one;
    if (one) showConfiguration(one);
    document.title = one ? `${one.name} · plab` : "plab: results";
    scrollTo(0, 0);
  }
  addEventListener("hashchange", route);
  showOverview();
  setTimeout(route);
  return { receive: (name, details) => { received.set(name, details); } };
})();
