/** Categories of decisions: name, the host's action, the letter of the graph's keys. */

export const CATEGORIES = /** @type {[string, string, string][]} */ ([
  ["publish", "publish a topic", "t"], ["subscribe", "subscribe to a topic", "t"], ["offer", "offer a service", "s"],
  ["call", "call a service", "s"], ["command", "make a call", "t"], ["node", "use a node name", "n"],
  ["read", "read a parameter", "t"], ["write", "write a parameter", "t"],
]);

/** @param {string | null | undefined} category */
export const letterOf = (category) => CATEGORIES.find(([word]) => word === category)?.[2] ?? "t";

/** @param {string} category */
export const isDecided = (category) => CATEGORIES.some(([word]) => word === category);
