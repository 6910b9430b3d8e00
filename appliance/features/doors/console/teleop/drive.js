/**
 * Drive a base through a door: publish a velocity while the pad is held, and stop it in every other case.
 *
 * 1. `stop` sends zeros at once, and ends the publication. Nothing is published after it.
 * 2. If the connection ends while it drives, the door publishes the zeros.
 * 3. While it drives, the door must answer within `SILENT`. Otherwise the connection ends with what it has not sent, so
 *    that no late command reaches the robot.
 */

const EVERY = 100; // milliseconds between two commands
const PROBE = 400;
const SILENT = 1000;
const MOST_UNSENT = 16_384; // bytes

/** Types of commands. @type {Record<string, (twist: any) => any>} */
export const COMMANDS = { "geometry_msgs/Twist": (twist) => twist, "geometry_msgs/TwistStamped": (twist) => ({ twist }) };

export class Drive {
  #door;
  #topic;
  #type;
  #told;
  #wanted = { forward: 0, left: 0 };
  #publication = /** @type {ReturnType<import("./connection.js").DoorConnection["advertise"]> | null} */ (null);
  #timers = /** @type {number[]} */ ([]);

  /** @param {import("./connection.js").DoorConnection} door @param {string} topic @param {string} type @param {(driving: boolean, why: string) => void} told */
  constructor(door, topic, type, told) {
    this.#door = door;
    this.#topic = topic;
    this.#type = type;
    this.#told = told;
  }

  get driving() {
    return this.#publication !== null;
  }

  /** Drive with this velocity until the next call or `stop`. @param {number} forward m/s @param {number} left rad/s */
  go(forward, left) {
    this.#wanted = { forward, left };
    if (this.#publication) return;
    let refused = false;
    this.#publication = this.#door.advertise(this.#topic, this.#type, this.#command(0, 0), (why) => {
      if (refused) return; // of the commands behind the first refusal
      refused = true;
      this.stop();
      this.#told(false, why); // even if the pad was released before
    });
    this.#publish();
    this.#timers = [setInterval(() => this.#publish(), EVERY), setInterval(() => this.#probe(), PROBE)];
    this.#told(true, "");
  }

  /** Stop the robot now. @param {string} [why] shown if it was not the person who stopped it */
  stop(why = "") {
    const publication = this.#publication;
    if (!publication) return;
    this.#publication = null;
    this.#timers.forEach(clearInterval);
    publication.publish(this.#command(0, 0));
    publication.end();
    this.#told(false, why);
  }

  #publish() {
    if (this.#door.unsent > MOST_UNSENT) this.#give("The network is too slow for commands: the robot was stopped.");
    else this.#publication?.publish(this.#command(this.#wanted.forward, this.#wanted.left));
  }

  async #probe() {
    const publication = this.#publication;
    try {
      await this.#door.call("/rosapi/get_time", {}, SILENT);
    } catch {
      if (publication && publication === this.#publication) this.#give("The door did not answer for a second, so the pad let go.");
    }
  }

  /** Stop, and end the connection. @param {string} why */
  #give(why) {
    this.stop(why);
    this.#door.close(why);
  }

  #command(/** @type {number} */ forward, /** @type {number} */ left) {
    return COMMANDS[this.#type]({ linear: { x: forward, y: 0, z: 0 }, angular: { x: 0, y: 0, z: left } });
  }
}
