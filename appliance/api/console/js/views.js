/** The views, in the order of their keys. Those of features follow those of the core; the robot's page is the last one. */

import { Audit } from "./audit/view.js";
import { PARTS } from "./features.js";
import { GraphView } from "./graph/view.js";
import { Monitors } from "./monitors/view.js";
import { Now } from "./now/view.js";
import { PolicyView } from "./policy/view.js";
import { RobotView } from "./robot.js";

const OWN = { Now, Graph: GraphView, Audit, Policy: PolicyView, Monitors };

export const VIEWS = [
  ...Object.entries(OWN).map(([title, View]) => ({ title, View })),
  ...PARTS.filter(({ place }) => place === "view").map(({ title, Part }) => ({ title, View: Part })),
  ...(PARTS.some(({ place }) => place === "robot") ? [{ title: "Robot", View: RobotView }] : []),
].map((one) => ({ name: one.title.toLowerCase(), ...one }));
