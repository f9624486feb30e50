// A configuration, or two side by side: pictures, films, curves, runs.
const received = new Map();

/** Load a configuration's curves and runs as a script, because pages opened as files cannot load data. */
function fetchDetails(name, react) {
  if (received.has(name)) { react(received.get(name)); return; }
  const script = make("script", { src: `data/${encodeURIComponent(name)}.js` });
  script.addEventListener("load", () => react(received.get(name)));
  script.addEventListener("error", () => react(null));
  document.head.append(script);
}

function showConfigurations(shown) {
  const [one, beside] = shown, at = configurations.indexOf(one), suffix = beside ? `&${beside.name}` : "";
  const link = (other, text) => (other ? make("a", { href: `#${other.name}${suffix}` }, text) : "");
  const others = configurations.filter((other) => other !== one && runsOf(other));
  const choice = make("select", { id: "beside", "aria-label": "configuration to compare with" }, make("option", { value: "" }, "compare with …"),
    ...others.map((other) => make("option", { value: other.name, selected: other === beside ? "" : null }, other.name)));
  choice.addEventListener("change", () => { location.hash = one.name + (choice.value && `&${choice.value}`); });
  redraws.clear();
  find("#configuration").replaceChildren(
    make("nav", { class: "way" }, make("a", { href: "#" }, "← all configurations"), make("span"), others.length ? choice : "",
      link(configurations[at - 1], "previous"), link(configurations[at + 1], "next")),
    make("div", { class: beside ? "beside" : "" }, ...shown.map(showConfiguration)));
}

function showConfiguration(one) {
  const place = make("article", { "data-name": one.name }, make("h1", {}, `${one.task}, variant ${one.variant}`));
  if (!runsOf(one)) {
    place.append(make("p", { class: "missing" }, "This configuration has no finished runs. To start one: ",
      make("code", {}, `plab run task=${one.task} variant=${one.variant}`)));
    return place;
  }
  place.append(pictures(one));
  fetchDetails(one.name, (details) => {
    if (!details) { place.append(make("p", { class: "missing" }, `data/${one.name}.js is missing: generate the page again.`)); return; }
    place.append(...films(one, details), ...chart(details), ...runTable(one, details));
  });
  return place;
}

function pictures(one) {
  const made = ["start", "target"].filter((what) => one.pictures[what]);
  if (!made.length) {
    return make("p", { class: "missing" }, "No pictures yet: ", make("code", {}, "plab report html"), " renders them; it requires OpenGL and ", make("code", {}, "pip install 'plab[render]'"), ".");
  }
  return make("div", { class: "pictures" }, ...made.map((what) => make("figure", {},
    make("img", { src: one.pictures[what], alt: `${one.name}: ${what}`, width: 480, height: 360 }),
    make("figcaption", {}, make("b", {}, what), make("small", {}, what === "start" ? "with the translucent target" : "shown as plasticine")))));
}

function films(one, details) {
  const shown = methods.filter(({ name }) => details[name] && one.pictures[name]);
  if (!shown.length) return [];
  const figures = shown.map(({ name, label }) => {
    const { ours, paper } = one.cells[name], best = details[name].runs.find((run) => run.hash === details[name].best);
    const printed = paper.count ? `; paper ${fixed(paper.mean)} ± ${fixed(paper.std)}` : "";
    return make("figure", {}, ...filmOrPicture(one.pictures[`${name} film`], one.pictures[name], `${one.name} by ${label}`),
      make("figcaption", {}, make("span", { class: "swatch", style: own(name) }), make("b", {}, label), `score ${fixed(best.score)}, seed ${best.seed}`,
        make("small", {}, `all seeds ${fixed(ours.mean)}${ours.count > 1 ? ` ± ${fixed(ours.std)}` : ""} (${ours.count}/${ours.expected})${printed}`)));
  });
  const grid = make("div", { class: "pictures" }, ...figures);
  const head = make("div", { class: "heading" }, make("h2", {}, shown.length > 1 ? "The best run of each method" : "The best run"), playAll(grid) ?? "");
  return [head, grid, make("p", { class: "note" }, "Replayed in the hard contact model; pictures show the last state.")];
}

function runTable(one, details) {
  const body = methods.filter(({ name }) => details[name]).flatMap(({ name, label }) => details[name].runs.map((run) => {
    const copy = make("button", { type: "button", class: "copy", title: run.command }, "copy command");
    copy.addEventListener("click", async () => {
      const copied = await copyText(run.command);
      copy.textContent = copied ? "copied" : "copying failed: select the command here";
      if (!copied && !find("code", copy.parentElement)) copy.after(make("code", { class: "whole" }, run.command));
    });
    const time = `${fixed(run.seconds, 1)} s`, place = `${run.device}${run.batch > 1 ? `, batch of ${run.batch}` : ""}`;
    const numbers = [run.seed, fixed(run.score, 3), fixed(run.iou, 3), run.loss === null ? "–" : run.loss.toPrecision(4).replace("-", "−"), `${run.best_iteration} of ${run.iterations}`, time];
    return make("tr", {}, make("td", {}, make("span", { class: "swatch", style: own(name) }), ` ${label}`),
      ...numbers.map((text) => make("td", { class: "number" }, String(text))), make("td", {}, place),
      make("td", {}, make("code", { title: `${run.hash}\n${run.path}` }, run.hash.slice(0, 8))), make("td", {}, copy));
  }));
  const heads = ["method", "seed", "score", "soft IoU", "best loss", "best row", "time", "computed on", "SHA-256", ""];
  const head = make("tr", {}, ...heads.map((text, at) => make("th", { class: at > 0 && at < 7 ? "number" : "" }, text)));
  const chosen = details[one.best], best = chosen.runs.find((run) => run.hash === chosen.best);
  const commands = [best.command, `plab render ${best.path} --output rollout.mp4`].map((text) => make("code", {}, text));
  return [make("h2", {}, "Runs"), make("div", { class: "scroll" }, make("table", { class: "plain runs" }, make("thead", {}, head), make("tbody", {}, ...body))),
    make("p", { class: "note" }, "Times of runs in a batch are each run's share. The run with the highest score is repeated and rendered by"), make("div", { class: "commands" }, ...commands)];
}

const curveView = { column: "reward", axis: "episodes", scale: "log", hidden: new Set() };
const redraws = new Set();

function chart(details) {
  const shown = methods.filter(({ name }) => details[name]);
  const group = (name, values, texts) => {
    const buttons = values.map((value) => make("button", { type: "button", value }, texts[value] ?? value));
    const made = make("div", { class: "choice", role: "group", "aria-label": name }, ...buttons);
    const press = () => { for (const each of buttons) each.setAttribute("aria-pressed", each.value === curveView[name]); };
    press();
    redraws.add(press);
    choose(made, (value) => { curveView[name] = value; for (const redraw of redraws) redraw(); });
    return made;
  };
  const curves = (visible) => visible.flatMap(({ name, label, dashes }) => {
    const points = details[name].curves[curveView.column][curveView.axis], ceiling = ["score", "iou"].includes(curveView.column) ? 1 : Infinity;
    if (!points) return [];
    const [x, y, std] = points;
    return [{ name, label, dashes, x, y, low: y.map((value, k) => value - std[k]), high: y.map((value, k) => Math.min(value + std[k], ceiling)) }];
  });
  const [box, draw] = chartBox("curves", shown, curveView.hidden, curves, () => ({
    log: curveView.scale === "log", bottom: curveView.column === "loss" ? null : 0, top: curveView.column === "score" ? 1 : null, label: labels[curveView.axis], side: labels[curveView.column] ?? curveView.column,
    heading: (x) => `${curveView.axis === "episodes" ? Math.round(x) : short(x)} ${curveView.axis}`,
  }));
  redraws.add(draw);
  const head = make("div", { class: "heading" }, make("h2", {}, "Curves"), group("column", content.columns, shortLabels),
    group("axis", content.axes, shortLabels), group("scale", ["log", "linear"], {}));
  const note = "Lines: mean over the seeds; shaded: one standard deviation. Gradient methods are shown in the contact model of their rollouts (soft, except for Adam-H), RL in the hard one, so ends may differ from the scores above. Rewards and scores below zero count as zero, as in the paper.";
  return [head, box, make("p", { class: "note" }, note)];
}
