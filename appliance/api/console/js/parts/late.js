/** Components that the page loads when they are first shown. */

import { html } from "../html.js";
import { OUTDATED } from "../outdated.js";
import { Failure, Loading } from "./notice.js";
import { useResource } from "./resource.js";

/** @param {() => Promise<any>} load imports the module @param {string} name of its component */
export function late(load, name) {
  let Part = /** @type {any} */ (null);
  const fetched = async () => {
    try {
      Part ??= (await load())[name];
    } catch {
      throw new Error(OUTDATED);
    }
  };
  return function Late(/** @type {any} */ given) {
    const { error, again } = useResource(fetched, []);
    return Part ? html`<${Part} ...${given} />` : error ? html`<${Failure} error=${error} retry=${again} />` : html`<${Loading} rows=${3} />`;
  };
}
