/** Categories of decisions: the name, the host's action, and the letter that the graph's keys use. */

export const CATEGORIES = /** @type {[string, string, string][]} */ ([
  ["publish", "publish a topic", "t"], ["subscribe", "subscribe to a topic", "t"], ["offer", "offer a service", "s"],
  ["call", "call a service", "s"], ["command", "make a call", "t"], ["node", "use a node name", "n"],
  ["read", "read a parameter", "t"], ["write", "write a parameter", "t"],
]);

/** @param {string | null | undefined} category */
export const letterOf = (category) => CATEGORIES.find(([word]) => word === category)?.[2] ?? "t";

/** @param {string} category */
export const isDecided = (category) => CATEGORIES.some(([word]) => word === category);
