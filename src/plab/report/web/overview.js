// The table of all configurations, sorted and searched.
const state = { sort: "task", descending: false };
const runsOf = (one) => methods.reduce((sum, { name }) => sum + one.cells[name].ours.count, 0);
const withRuns = methods.filter(({ name }) => configurations.some(({ cells }) => cells[name].ours.count));
const expectedOf = (one) => withRuns.reduce((sum, { name }) => sum + one.cells[name].ours.expected, 0);
const only = find("#only");
only.checked = configurations.some(runsOf) && !configurations.every(runsOf);

function sortKey(one, position) {
  if (state.sort === "task") return position;
  if (state.sort === "variant") return Number(one.variant) || 0;
  if (state.sort === "runs") return runsOf(one);
  const cells = one.cells[state.sort];
  return view.form === "difference" ? cells.difference[0] : cells[view.form].mean;
}

function showOverview() {
  const words = find("#search").value.toLowerCase().split(/\s+/).filter(Boolean), shown = methodsIn(configurations);
  if (!["task", "variant", "runs", ...shown.map(({ name }) => name)].includes(state.sort)) state.sort = "task";
  const rows = configurations
    .map((one, position) => ({ one, key: sortKey(one, position) }))
    .filter(({ one }) => !only.checked || runsOf(one))
    .filter(({ one }) => words.every((word) => one.name.toLowerCase().includes(word)));
  // Rows without a number come last in both orders.
  rows.sort((a, b) => (a.key === null) - (b.key === null) || (state.descending ? b.key - a.key : a.key - b.key));
  const body = rows.map(({ one }) => {
    const row = make("tr", { "data-name": one.name, class: runsOf(one) ? "" : "without" },
      make("td", {}, make("a", { href: `#${one.name}` }, one.task)), make("td", { class: "number" }, one.variant),
      ...shown.map((each) => cellOf(one, each, shown)), make("td", { class: "number" }, `${runsOf(one)}/${expectedOf(one)}`));
    row.addEventListener("click", () => { location.hash = one.name; });
    return row;
  });
  const heads = [["task", ["task"]], ["variant", ["variant"]], ...shown.map((each) => [each.name, headOf(each)]), ["runs", ["runs"]]];
  find("#configurations").replaceChildren(make("thead", {}, make("tr", {}, ...heads.map((each) => headCell(...each)))), make("tbody", {}, ...body));
  find("#nothing").hidden = rows.length > 0;
  find("#count").value = `${rows.length} of ${configurations.length} configurations`;
}

function headCell(sort, text) {
  const button = make("button", { type: "button" }, ...text);
  button.addEventListener("click", () => {
    // Scores are sorted from the best downwards first.
    state.descending = state.sort === sort ? !state.descending : !["task", "variant"].includes(sort);
    state.sort = sort;
    showOverview();
    find(`#configurations th[data-sort="${CSS.escape(sort)}"] button`).focus();
  });
  const way = state.sort !== sort ? null : state.descending ? "descending" : "ascending";
  return make("th", { "data-sort": sort, class: sort === "task" ? null : "number", "aria-sort": way }, button);
}

find("#search").addEventListener("input", showOverview);
only.addEventListener("change", showOverview);
choose(find("#form"), (value) => { view.form = value; showTasks(); showOverview(); });
