/** Do what may fail, and show the failure. */

import { useState } from "../html.js";
import { failed } from "./toast.js";

/** A failure is shown in a corner. @param {() => any} work @param {() => any} [after] called after a failure, too */
export async function attempt(work, after) {
  try {
    await work();
  } catch (failure) {
    failed(failure);
  }
  await after?.();
}

/** The failure of a form's last attempt, and the function that makes one. @returns {[any, (work: () => any) => Promise<void>]} */
export function useAttempt() {
  const [error, setError] = useState(/** @type {any} */ (null));
  const attempt = async (/** @type {() => any} */ work) => {
    setError(null);
    try {
      await work();
    } catch (failure) {
      setError(failure);
    }
  };
  return [error, attempt];
}
