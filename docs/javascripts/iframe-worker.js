// Browsers run no worker for a page that is opened as a file.  There, an invisible frame runs the
// script of the search in its stead, with the messages of a worker.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(script) {
      super();
      this.waiting = [];
      this.frame = document.createElement("iframe");
      this.frame.hidden = true;
      this.frame.onload = () => this.start(script);
      document.body.append(this.frame);
    }

    start(script) {
      const room = this.frame.contentWindow;
      room.postMessage = (data) => this.dispatchEvent(new MessageEvent("message", { data }));
      const tag = room.document.createElement("script");
      tag.src = script;
      tag.onload = () => {
        this.room = room;
        this.waiting.splice(0).forEach((data) => this.postMessage(data));
      };
      room.document.body.append(tag);
    }

    postMessage(data) {
      if (this.room) this.room.dispatchEvent(new MessageEvent("message", { data }));
      else this.waiting.push(data);
    }

    terminate() {
      this.frame.remove();
    }
  };
}
