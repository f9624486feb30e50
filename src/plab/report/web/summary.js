// Start of the page: a gallery, a row per task, and the table of all configurations.
const view = { form: "ours" };

/** Return the methods that have a number in any of the rows, each with cells by method. */
function methodsIn(rows) {
  const counted = view.form === "paper" ? "paper" : "ours";
  return methods.filter(({ name }) => rows.some(({ cells }) => cells[name][counted].count && (view.form !== "difference" || cells[name].paper.count)));
}

/** Make the cell of a method in a row of scores. */
function cellOf({ cells }, { name }, rivals) {
  const { ours, paper, difference } = cells[name], shown = { ours, paper }[view.form];
  const td = make("td", { class: "number value", style: own(name) });
  if (view.form === "difference") {
    const [value, low, high] = difference;
    if (value === null) return make("td", { class: "number none" }, "–");
    td.append(make("span", {}, make("b", {}, signed(value)), " ", make("small", {}, low === null ? "" : `[${signed(low)}, ${signed(high)}]`)));
    return td;
  }
  if (!shown.count) return make("td", { class: "number none" }, view.form === "ours" ? `0/${ours.expected}` : "–");
  td.style.setProperty("--part", Math.min(Math.max(shown.mean, 0), 1));
  const best = Math.max(...rivals.map((each) => cells[each.name][view.form].mean ?? -1));
  if (shown.mean === best) td.classList.add("best");
  const spread = shown.count > 1 ? `± ${fixed(shown.std)}` : "";
  const lacking = view.form === "ours" && shown.count < ours.expected ? ` (${shown.count}/${ours.expected})` : "";
  td.append(make("span", {}, make("b", {}, fixed(shown.mean)), " ", make("small", {}, spread + lacking)));
  return td;
}

const headOf = ({ name, label }) => [make("i", { style: own(name) }), label];

function showGallery() {
  const figures = content.gallery.filter(({ name }) => pictureOf(name).start).map(({ task, name, method, seed, score }) => {
    const made = pictureOf(name), { label } = methodNamed.get(method), text = `${name} by ${label}`;
    return make("figure", { "data-task": task }, ...filmOrPicture(made[`${method} film`], made[method], text),
      make("figcaption", {}, make("a", { href: `#${name}` }, task), make("b", {}, fixed(score)),
        make("small", {}, make("span", { class: "swatch", style: own(method) }), ` ${label}, variant ${name.split("-v").at(-1)}, seed ${seed}`)));
  });
  const grid = make("div", { class: "pictures small" }, ...figures);
  const lacking = content.gallery.filter(({ name }) => !pictureOf(name).start).map(({ task }) => task);
  const note = lacking.length ? make("p", { class: "note" }, `No pictures of ${lacking.join(", ")}.`) : "";
  find("#gallery").replaceChildren(...(figures.length ? [make("div", { class: "heading" }, make("h2", {}, "The best run of each task"), playAll(grid) ?? ""), grid, note] : []));
}
const pictureOf = (name) => configurations.find((one) => one.name === name).pictures;

function showTasks() {
  const rows = content.tasks, shown = methodsIn(rows);
  const head = make("tr", {}, make("th", {}, "task"), ...shown.map((each) => make("th", { class: "number" }, ...headOf(each))));
  const body = rows.map((row) => {
    const link = make("button", { type: "button", class: "link" }, row.task);
    link.addEventListener("click", () => {
      find("#search").value = row.task;
      find("#search").dispatchEvent(new Event("input"));
      find("#search").scrollIntoView({ block: "center" });
    });
    return make("tr", { "data-task": row.task }, make("td", {}, link), ...shown.map((each) => cellOf(row, each, shown)));
  });
  find("#tasks").replaceChildren(make("thead", {}, head), make("tbody", {}, ...body));
}
