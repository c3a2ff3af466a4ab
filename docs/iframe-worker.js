// The search of a page that is opened from the disk. There a browser starts no workers, so the search's script runs in a frame of the same page.
// (The name is the one by which Zensical knows that it need not fetch such a script from the network.)
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super()
      this.onmessage = this.onerror = this.onmessageerror = null
      this.frame = document.createElement("iframe")
      this.frame.hidden = true
      this.ready = new Promise((resolve, reject) => {
        this.frame.onload = () => {
          const inside = this.frame.contentWindow
          inside.postMessage = data => this.say(new MessageEvent("message", { data }))
          const script = inside.document.createElement("script")
          script.src = new URL(url, location)
          script.onload = resolve
          script.onerror = () => { this.say(new Event("error")); reject(new Error(`${script.src} cannot be loaded`)) }
          inside.document.body.append(script)
        }
      })
      document.body.append(this.frame)
    }

    say(event) {
      this[`on${event.type}`]?.(event)
      this.dispatchEvent(event)
    }

    postMessage(data) {
      this.ready.then(() => this.frame.contentWindow.dispatchEvent(new MessageEvent("message", { data })), () => {})
    }

    terminate() {
      this.frame.remove()
    }
  }
}
