// What Foxglove's own client library hears of a server, as JSON lines: node client.mjs ws://ADDRESS:PORT TOPIC...
// First a line with the channels advertised, by topic, then one for each message. It ends with its input, or
// with the connection: status 0. Any error of library or socket, or a status that the server sends, ends it with 1.
import ws from "@foxglove/ws-protocol";
import WebSocket from "ws";

const { FoxgloveClient } = ws;
const [address, ...topics] = process.argv.slice(2);
const text = new TextDecoder("utf-8", { fatal: true });
const channels = new Map(); // by topic
const topicOf = new Map(); // by subscription
const say = (line) => process.stdout.write(`${JSON.stringify(line)}\n`);

function fail(why) {
  console.error(why);
  process.exit(1);
}

// The library leaves it to the socket to name the subprotocol: its own constant is what it was called before the SDK.
const client = new FoxgloveClient({ ws: new WebSocket(address, ["foxglove.sdk.v1"]) });
client.on("error", fail);
client.on("status", fail);
client.on("close", () => process.exit(0));
client.on("advertise", (advertised) => {
  const missing = topics.filter((topic) => !channels.has(topic));
  for (const channel of advertised) channels.set(channel.topic, channel);
  if (missing.length === 0 || !topics.every((topic) => channels.has(topic))) return;
  say(Object.fromEntries(channels));
  for (const topic of topics) topicOf.set(client.subscribe(channels.get(topic).id), topic);
});
client.on("message", ({ subscriptionId, timestamp, data }) => {
  say([topicOf.get(subscriptionId), String(timestamp), JSON.parse(text.decode(data))]);
});
process.stdin.on("end", () => client.close()).resume();
