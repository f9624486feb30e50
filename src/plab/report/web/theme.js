// The button #theme of every page: light or dark, remembered.
(() => {
  const root = document.documentElement;
  const memory = { // storage may be forbidden for pages from the file system
    get: () => { try { return localStorage.getItem("plab-theme"); } catch { return null; } },
    set: (value) => { try { localStorage.setItem("plab-theme", value); } catch { /* the choice is lost with the page */ } },
  };
  if (["light", "dark"].includes(memory.get())) root.dataset.theme = memory.get();
  document.querySelector("#theme").addEventListener("click", () => {
    const dark = root.dataset.theme ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
    root.dataset.theme = dark ? "light" : "dark";
    memory.set(root.dataset.theme);
  });
})();
