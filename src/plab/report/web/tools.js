// Shared functions of the page of results. All numbers are in the element #content; curves and runs are in
// data/<configuration>.js.
const content = JSON.parse(document.getElementById("content").textContent);
const { methods, configurations } = content;
const labels = {
  episodes: "episodes", seconds: "wall time [s], share of the batch", substeps: "simulated substeps",
  reward: "reward", score: "score", iou: "soft IoU", loss: "loss",
};
const shortLabels = { ...labels, seconds: "wall time" };
const find = (selector, within = document) => within.querySelector(selector);
const all = (selector, within = document) => [...within.querySelectorAll(selector)];

/** Create an element; text is never interpreted as HTML. */
function make(name, attributes = {}, ...children) {
  const drawing = ["svg", "path", "line", "text", "g", "rect", "circle"].includes(name);
  const node = drawing ? document.createElementNS("http://www.w3.org/2000/svg", name) : document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) if (value !== null) node.setAttribute(key, value);
  node.append(...children.filter((child) => child !== null));
  return node;
}
/** Format a number with a minus sign instead of a hyphen. */
const fixed = (value, digits = 2) => {
  if (value === null) return "–";
  const text = Math.abs(value).toFixed(digits);
  return value < 0 && Number(text) ? `−${text}` : text;
};
const signed = (value) => (value >= 0.005 ? "+" : "") + fixed(value);
const properties = new Map(methods.map(({ name, css }) => [name, css]));
const colour = (name) => `var(--${properties.get(name)})`;
const own = (name) => `--own: ${colour(name)}`;
const methodNamed = new Map(methods.map((method) => [method.name, method]));

/** Turn a row of buttons into an exclusive choice. */
function choose(group, react) {
  for (const button of all("button", group)) {
    button.addEventListener("click", () => {
      for (const each of all("button", group)) each.setAttribute("aria-pressed", each === button);
      react(button.value);
    });
  }
}

/** Copy text to the clipboard; return whether that succeeded. */
async function copyText(text) {
  try {
    await navigator.clipboard.writeText(text);
    return true;
  } catch { /* the clipboard requires a secure context and a permission */ }
  const field = make("textarea", { readonly: "", class: "aside" });
  field.value = text;
  document.body.append(field);
  field.select();
  const done = document.execCommand("copy");
  field.remove();
  return done;
}

/** Create a film with a button to start and stop it, or a picture if there is no film. */
function filmOrPicture(film, picture, text) {
  if (!film) return [make("img", { src: picture, alt: text, loading: "lazy", width: 480, height: 360 })];
  const video = make("video", { src: film, poster: picture, loop: "", playsinline: "", preload: "none", width: 480, height: 360, "aria-label": text });
  video.muted = true;
  const button = make("button", { type: "button", class: "start", "aria-label": `play or stop ${text}` });
  const turn = () => { if (video.paused) video.play(); else video.pause(); };
  for (const node of [button, video]) node.addEventListener("click", turn);
  for (const what of ["play", "pause"]) video.addEventListener(what, () => video.parentElement.classList.toggle("playing", !video.paused));
  return [video, button];
}

/** Create a button that plays or stops all films of a grid; null without films. */
function playAll(grid) {
  const videos = all("video", grid);
  if (!videos.length) return null;
  const button = make("button", { type: "button", class: "play" }, "play all");
  button.addEventListener("click", () => {
    const start = videos.some((video) => video.paused);
    for (const video of videos) { if (start) { video.currentTime = 0; video.play(); } else video.pause(); }
  });
  return button;
}
