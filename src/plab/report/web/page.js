// Routing: the parts of the page shown for an address.
globalThis.plab = {
  /** Called by data/<configuration>.js. */
  receive: (name, details) => { received.set(name, details); },
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
showOverview();
route();
