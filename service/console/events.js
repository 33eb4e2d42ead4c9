// Server-sent events of any kind; EventSource hears only those whose names it was told.

const AGAIN_MS = 1000;

// Calls tell(kind, data) for every event after the first, again and again until `end` or abort.
export async function follow(path, tell, signal) {
  let seen = "0";
  while (!signal.aborted) {
    try {
      const answer = await fetch(path, { headers: { "Last-Event-ID": seen }, signal });
      for await (const event of eventsOf(answer.body)) {
        if (signal.aborted) return;
        if (event.event === "end") return;
        seen = event.id;
        tell(event.event, JSON.parse(event.data));
      }
    } catch (error) {
      if (signal.aborted) return;
    }
    await new Promise((resolve) => setTimeout(resolve, AGAIN_MS));
  }
}

async function* eventsOf(body) {
  const reader = body.pipeThrough(new TextDecoderStream()).getReader();
  let text = "";
  for (;;) {
    const { value, done } = await reader.read();
    if (done) return;
    const blocks = (text + value).split("\n\n");
    text = blocks.pop();
    for (const block of blocks) {
      const fields = block.split("\n").filter((line) => line && !line.startsWith(":"));
      if (!fields.length) continue;
      yield Object.fromEntries(fields.map((line) => line.split(/: (.*)/s).slice(0, 2)));
    }
  }
}
