// Uses a door with roslib as a dashboard does, and prints one JSON object a line: node client.mjs URL.
// It publishes on three topics twice a second, and advertises each of them once, like any program with roslib.
import * as ROSLIB from "roslib";

const say = (what) => console.log(JSON.stringify(what));
const ros = new ROSLIB.Ros({ url: process.argv[2] });
const topic = (name) => new ROSLIB.Topic({ ros, name, messageType: "std_msgs/String" });
const call = (name) => {
  const service = new ROSLIB.Service({ ros, name, serviceType: "std_srvs/SetBool" });
  service.callService(
    { data: true },
    (answer) => say({ event: "answered", service: name, ...answer }),
    (error) => say({ event: "not answered", service: name, error }),
    20,
  );
};

ros.on("error", (error) => say({ event: "error", error: String(error) }));
ros.on("status", (status) => say({ event: "status", level: status.level, words: status.msg }));
ros.on("close", () => say({ event: "closed" }));
ros.on("connection", () => {
  topic("/chatter").subscribe((message) => say({ event: "heard", data: message.data }));
  const published = ["/answer", "/forbidden", "/held"].map(topic);
  for (const one of published) one.advertise();
  setInterval(() => published.forEach((one) => one.publish({ data: `to ${one.name}` })), 500);
  call("/brake");
  call("/forbidden_brake");
});
