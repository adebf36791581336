// The search runs in a worker, which browsers refuse to a page that is opened from a disk. There, a hidden frame runs it.
if (location.protocol === "file:") {
  window.Worker = window.IFrameWorker = class extends EventTarget {
    constructor(url) {
      super()
      const frame = document.createElement("iframe")
      frame.hidden = true
      frame.srcdoc = `<script>postMessage = data => parent.postMessage(data, "*")</script><script src="${url}"></script>`
      this.frame = new Promise(ready => frame.addEventListener("load", () => ready(frame.contentWindow)))
      addEventListener("message", event => {
        if (event.source === frame.contentWindow) this.dispatchEvent(new MessageEvent("message", { data: event.data }))
      })
      document.body.append(frame)
    }

    postMessage(data) {
      this.frame.then(frame => frame.postMessage(data, "*"))
    }
  }
}
