// The leaderboard: which lines and columns are shown, and in which order. All numbers are in the tables.
(() => {
  const all = (selector, within = document) => [...within.querySelectorAll(selector)];
  const chosen = { track: "", gradient: "" };

  function press(button) {
    for (const other of all("button", button.parentElement)) other.setAttribute("aria-pressed", String(other === button));
  }

  for (const group of all("[data-filter]")) {
    group.addEventListener("click", ({ target }) => {
      if (target.tagName !== "BUTTON") return;
      press(target);
      chosen[group.dataset.filter] = target.value;
      for (const body of all(".board tbody")) {
        const rows = all("tr[data-track]", body);
        for (const row of rows) row.hidden = Object.entries(chosen).some(([key, value]) => value && row.dataset[key] !== value);
        const empty = body.querySelector(".empty");
        empty.hidden = rows.some((row) => !row.hidden);
        if (rows.length) empty.firstElementChild.textContent = "Nothing of this track.";
      }
    });
  }

  document.querySelector("#form").addEventListener("click", ({ target }) => {
    if (target.tagName !== "BUTTON") return;
    press(target);
    for (const table of all(".board")) table.classList.toggle("by-task", target.value === "tasks");
  });

  for (const head of all(".board th")) {
    head.addEventListener("click", () => {
      const column = head.cellIndex, body = head.closest("table").tBodies[0];
      const numeric = head.classList.contains("number");
      const before = head.getAttribute("aria-sort");
      const descending = before ? before === "ascending" : numeric;
      for (const other of all("th", head.parentElement)) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", descending ? "descending" : "ascending");
      const value = (row) => row.cells[column].dataset.value;
      const compare = numeric ? (a, b) => value(a) - value(b) : (a, b) => value(a).localeCompare(value(b));
      const rows = all("tr[data-track]", body).sort((a, b) => (descending ? -1 : 1) * compare(a, b));
      body.prepend(...rows);
    });
  }
})();
