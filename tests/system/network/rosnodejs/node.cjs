// A node of rosnodejs: node.cjs HEARD SAID SERVICE OFFERED. It subscribes to HEARD, publishes numbers on SAID 50 times
// a second, calls SERVICE at 20 Hz, ordinary and over a kept connection, and offers OFFERED. Each line on standard
// input is answered with the numbers of calls, in the event `counted`.
"use strict";
const readline = require("node:readline");
const rosnodejs = require("rosnodejs");

const report = (event, fields = {}) => process.stdout.write(JSON.stringify({ event, ...fields }) + "\n");

async function main() {
  const [heard, said, service, offered] = process.argv.slice(2);
  const node = await rosnodejs.initNode("/rosnodejs", { onTheFly: true, node: { forceExit: true } });
  const text = "std_msgs/String";
  node.subscribe(heard, text, (message) => report("received", { data: message.data }), { queueSize: 1000 });
  node.advertiseService(offered, "std_srvs/SetBool", (request, response) => {
    response.success = !request.data;
    return true;
  });
  const publisher = node.advertise(said, text, { queueSize: 1000 });
  let number = 0;
  setInterval(() => publisher.publish({ data: `hello ${++number}` }), 20);

  const counts = {};
  for (const [name, persist] of [["ordinary", false], ["persistent", true]]) {
    const client = node.serviceClient(service, "std_srvs/SetBool", { persist });
    const count = (counts[name] = { good: 0, bad: 0 });
    let under_way = false;
    setInterval(async () => {
      if (under_way) return;
      under_way = true;
      try {
        await client.call({ data: true });
        count.good++;
      } catch (error) {
        count.bad++;
        report("failed", { client: name, reason: String(error) });
      }
      under_way = false;
    }, 50);
  }
  readline.createInterface({ input: process.stdin }).on("line", () => report("counted", counts));
  report("ready");
}

main();
