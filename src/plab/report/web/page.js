// What is shown at which address, and the page made again.
globalThis.plab = {
  /** Called by data/<configuration>.js. */
  receive: (name, details) => { received.set(name, details); },
  /** Called by data/state.js: the page that is there now. */
  state: (name) => { if (name !== content.state) location.reload(); },
};

function route() {
  const names = decodeURIComponent(location.hash).slice(1).split("&");
  const shown = names.map((wanted) => configurations.find(({ name }) => name === wanted)).filter(Boolean).slice(0, 2);
  find("#overview").hidden = shown.length > 0;
  find("#configuration").hidden = !shown.length;
  if (shown.length) showConfigurations(shown);
  document.title = shown.length ? `${shown.map(({ name }) => name).join(" and ")} · plab` : "plab: results";
}
addEventListener("hashchange", () => { route(); scrollTo(0, 0); });
showGallery();
showTasks();
showAggregates();
showOverview();
route();

if (content.live) {
  // A page from the file system may ask nothing but scripts whether there is a newer one.
  setInterval(() => {
    const script = make("script", { src: `data/state.js?${Date.now()}` });
    for (const what of ["load", "error"]) script.addEventListener(what, () => script.remove());
    document.head.append(script);
  }, content.every);
}
