/**
 * The rosbridge connection of a door, with its rights. Every refusal reaches its caller in the words of the door.
 *
 * A connection is never opened again: the view gets a new ticket and makes a new one.
 */

const OPENING = 10_000; // milliseconds
const ANSWER = 10_000;

/** @typedef {(text: string) => void} Refused called with the door's words */

export class DoorConnection {
  #socket;
  #ended;
  #number = 0;
  #refused = /** @type {Map<string, Refused>} */ (new Map());
  #heard = /** @type {Map<string, Set<(message: any) => void>>} */ (new Map());
  #calls = /** @type {Map<string, {resolve: (values: any) => void, reject: (error: Error) => void, timer: number}>} */ (new Map());

  /** @param {string} address @param {() => void} opened @param {(reason: string) => void} ended called once */
  constructor(address, opened, ended) {
    this.#ended = /** @type {((reason: string) => void) | null} */ (ended);
    this.#socket = new WebSocket(address);
    const late = setTimeout(() => this.#end("The door does not answer."), OPENING);
    this.#socket.onopen = () => {
      clearTimeout(late);
      opened();
    };
    this.#socket.onmessage = ({ data }) => this.#take(JSON.parse(data));
    this.#socket.onclose = ({ reason, wasClean }) => {
      clearTimeout(late);
      this.#end(reason || (wasClean ? "The door ended the connection." : "The connection broke, or the door did not accept it."));
    };
  }

  /** Bytes that the network has not taken yet. */
  get unsent() {
    return this.#socket.bufferedAmount;
  }

  /** @param {string} [reason] */
  close(reason = "") {
    this.#end(reason);
  }

  /**
   * Hear a topic; returns the function that ends it. @param {string} topic @param {{interval: number, newest?: boolean}} rate `interval`: least
   * milliseconds between two messages; `newest`: to a slow network, the door sends only the newest message
   * @param {(message: any) => void} heard @param {Refused} refused
   */
  subscribe(topic, { interval, newest = false }, heard, refused) {
    const id = this.#begin(refused);
    const all = this.#heard.get(topic) ?? new Set();
    this.#heard.set(topic, all.add(heard));
    this.#send({ op: "subscribe", id, topic, throttle_rate: interval, queue_length: newest ? 1 : 0 });
    return () => {
      all.delete(heard);
      this.#refused.delete(id);
      this.#send({ op: "unsubscribe", id, topic });
    };
  }

  /**
   * Publish on a topic. The door publishes `will` if the connection ends before the publication.
   * @param {string} topic @param {string} type @param {any} will @param {Refused} refused
   */
  advertise(topic, type, will, refused) {
    const id = this.#begin(refused);
    this.#send({ op: "advertise", id, topic, type, will, queue_size: 1 });
    return {
      publish: (/** @type {any} */ msg) => this.#send({ op: "publish", id, topic, msg }),
      end: () => this.#send({ op: "unadvertise", id, topic }),
    };
  }

  /** Call a service. @param {string} service @param {any} [args] @param {number} [wait] milliseconds @returns {Promise<any>} */
  call(service, args = {}, wait = ANSWER) {
    const id = `call-${(this.#number += 1)}`;
    return new Promise((resolve, reject) => {
      const timer = setTimeout(() => {
        this.#calls.delete(id);
        reject(new Error("The door does not answer."));
      }, wait);
      this.#calls.set(id, { resolve, reject, timer });
      this.#send({ op: "call_service", id, service, args });
    });
  }

  #begin(/** @type {Refused} */ refused) {
    const id = `use-${(this.#number += 1)}`;
    this.#refused.set(id, refused);
    return id;
  }

  #send(/** @type {any} */ frame) {
    if (this.#socket.readyState === WebSocket.OPEN) this.#socket.send(JSON.stringify(frame));
  }

  #take(/** @type {any} */ frame) {
    if (frame.op === "publish") for (const heard of this.#heard.get(frame.topic) ?? []) heard(frame.msg);
    else if (frame.op === "status") this.#refused.get(frame.id)?.(frame.msg);
    else if (frame.op === "service_response") {
      const call = this.#calls.get(frame.id);
      if (!call) return;
      this.#calls.delete(frame.id);
      clearTimeout(call.timer);
      if (frame.result) call.resolve(frame.values);
      else call.reject(new Error(frame.values?.message ?? "refused"));
    }
  }

  #end(/** @type {string} */ reason) {
    const ended = this.#ended;
    this.#ended = null;
    this.#heard.clear();
    this.#refused.clear();
    this.#socket.close();
    for (const { reject, timer } of this.#calls.values()) {
      clearTimeout(timer);
      reject(new Error(reason || "The connection is closed."));
    }
    this.#calls.clear();
    ended?.(reason);
  }
}
