/** Whether this appliance is a standby, as the last answer of REST said. */

import { createStore } from "./store.js";

/** `active`: the address of the active appliance; empty: this appliance is not a standby. */
export const passive = createStore({ active: "" });
