/** What a host asks the policy for: the category of a decision, and what whoever asks wants to do. */

export const CATEGORIES = /** @type {[string, string][]} */ ([
  ["publish", "publish a topic"], ["subscribe", "subscribe to a topic"], ["offer", "offer a service"], ["call", "call a service"],
  ["command", "make a call"], ["node", "use a node name"], ["read", "read a parameter"], ["write", "write a parameter"],
]);

/** @param {string} category */
export const isDecided = (category) => CATEGORIES.some(([word]) => word === category);
