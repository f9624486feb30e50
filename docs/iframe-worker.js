// A worker for pages from the file system, where browsers have none: its script runs in a frame. The site's search
// looks for this name.
class IFrameWorker extends EventTarget {
  constructor(url) {
    super();
    const frame = document.createElement("iframe");
    frame.hidden = true;
    document.body.append(frame);
    this.inside = frame.contentWindow;
    addEventListener("message", (event) => {
      if (event.source !== this.inside) return;
      const message = new MessageEvent("message", { data: event.data });
      this.dispatchEvent(message);
      this.onmessage?.(message);
    });
    this.inside.document.open();
    this.inside.document.write(`<html><body><script>
      postMessage = (data) => parent.dispatchEvent(new MessageEvent("message", { data, source: window }));
      importScripts = (...urls) => urls.reduce((before, src) => before.then(() => new Promise((resolve) => {
        const script = document.createElement("script");
        script.src = src;
        script.addEventListener("load", resolve);
        document.body.append(script);
      })), Promise.resolve());
    <\/script><script src="${url}"><\/script></body></html>`);
    this.inside.document.close();
    // To open a document is to lose what listens to its window.
    this.ready = new Promise((resolve) => { this.inside.onload = resolve; });
  }

  postMessage(data) {
    this.ready.then(() => this.inside.dispatchEvent(new MessageEvent("message", { data })));
  }

  terminate() {}
}
if (location.protocol === "file:") { globalThis.IFrameWorker = IFrameWorker; globalThis.Worker = IFrameWorker; }
