/** The views, in the order of their keys. Those of features follow those of the core; the robot's page is the last one. */

import { PARTS } from "./features.js";
import { Now } from "./now/view.js";
import { late } from "./parts/late.js";
import { RobotView } from "./robot.js";

const OWN = {
  Now,
  Graph: late(() => import("./graph/view.js"), "GraphView"),
  Audit: late(() => import("./audit/view.js"), "Audit"),
  Policy: late(() => import("./policy/view.js"), "PolicyView"),
  Monitors: late(() => import("./monitors/view.js"), "Monitors"),
};

export const VIEWS = [
  ...Object.entries(OWN).map(([title, View]) => ({ title, View })),
  ...PARTS.filter(({ place }) => place === "view").map(({ title, Part }) => ({ title, View: Part })),
  ...(PARTS.some(({ place }) => place === "robot") ? [{ title: "Robot", View: RobotView }] : []),
].map((one) => ({ name: one.title.toLowerCase(), ...one }));
