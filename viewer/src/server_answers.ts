// Answers of the server that sent the page; see gsencoder/infer/page/server.py.

import { foundOf } from "./box_facts";
import { arrayOf, readContainer, type Container } from "./container";
import { Scene } from "./scene";
import type { Answer, Answers, Found, Labels, SceneMeta, SentBoxes } from "./types";

async function checked(response: Response): Promise<Response> {
  if (response.ok) return response;
  let message = `The server answered ${response.status}.`;
  try {
    message = ((await response.json()) as { error?: string }).error ?? message;
  } catch {
    // The status says enough.
  }
  throw new Error(message);
}

async function get(path: string): Promise<ArrayBuffer> {
  return (await checked(await fetch(path))).arrayBuffer();
}

async function post(path: string, body: unknown): Promise<Response> {
  const request = { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) };
  return checked(await fetch(path, request));
}

export async function sceneOfServer(number: number): Promise<Scene> {
  return new Scene(readContainer<SceneMeta>(await get(`scene/${number}`)));
}

export class ServerAnswers implements Answers {
  private readonly photographs = new Map<number, string>();
  private found: Promise<Labels> | null = null;

  constructor(
    private readonly number: number,
    private readonly scene: Scene,
  ) {}

  async ask(word: string): Promise<Answer> {
    const response = await post("ask", { scene: this.number, word });
    const sent: Container<{ threshold: number | null; step: number; unseen: number }> = readContainer(
      await response.arrayBuffer(),
    );
    const steps = arrayOf(sent, "relevancy", Int16Array);
    const { step, unseen, threshold } = sent.meta;
    const relevancy = new Float32Array(steps.length);
    for (let row = 0; row < steps.length; row++) {
      const value = steps[row] as number;
      relevancy[row] = value === unseen ? NaN : value * step;
    }
    return { word, relevancy, threshold };
  }

  async boxes(word: string, threshold: number | null): Promise<Found> {
    const response = await post("boxes", { scene: this.number, word, threshold });
    return foundOf((await response.json()) as SentBoxes, this.scene.meta.origin);
  }

  async bestWords(rows: number[]): Promise<[string, number][]> {
    const response = await post("words", { scene: this.number, rows });
    return ((await response.json()) as { words: [string, number][] }).words;
  }

  labels(): Promise<Labels> {
    this.found ??= get(`labels/${this.number}`).then((buffer) => {
      const sent = readContainer<{ names: string[] }>(buffer);
      return { names: sent.meta.names, numbers: arrayOf(sent, "numbers", Uint16Array) };
    });
    return this.found;
  }

  async photograph(view: number): Promise<string | null> {
    if (!this.scene.meta.photographs) return null;
    let address = this.photographs.get(view);
    if (!address) {
      const response = await checked(await fetch(`photograph/${this.number}/${view}`));
      address = URL.createObjectURL(await response.blob());
      this.photographs.set(view, address);
    }
    return address;
  }
}
