// Answers of a page that is one file: cosines from quantized coordinates; boxes were found when it was written.

import { foundOf } from "./box_facts";
import { arrayOf, type Container } from "./container";
import type { Scene } from "./scene";
import type { Answer, Answers, FileMeta, Found, Labels } from "./types";
import { WordTable } from "./words";

const WORD_STEP = 1 / 32767;

/** Coordinates of all Gaussians, zero where never seen; see gsencoder/fusion/quantize.py. */
export function decodeCoordinates(container: Container<FileMeta>): Float32Array {
  const { count, rank } = container.meta;
  const codes = arrayOf(container, "codes", Uint8Array);
  const bits = arrayOf(container, "bits", Uint8Array);
  const levels = arrayOf(container, "levels", Float32Array);
  const seen = arrayOf(container, "seen", Uint8Array);
  const width = Math.ceil(bits.reduce((sum, each) => sum + each, 0) / 8);
  const begins: number[] = [];
  let begin = 0;
  for (const each of bits) {
    begins.push(begin);
    begin += 1 << each;
  }
  const values = new Float32Array(count * rank);
  let row = 0;
  for (let gaussian = 0; gaussian < count; gaussian++) {
    if (!((seen[gaussian >> 3] ?? 0) & (128 >> (gaussian & 7)))) continue;
    let bit = 8 * width * row;
    for (let number = 0; number < rank; number++) {
      let code = 0;
      for (let left = bits[number] ?? 0; left > 0; left--, bit++) {
        code = (code << 1) | (((codes[bit >> 3] ?? 0) >> (7 - (bit & 7))) & 1);
      }
      values[gaussian * rank + number] = levels[(begins[number] ?? 0) + code] ?? 0;
    }
    row += 1;
  }
  return values;
}

export class FileAnswers implements Answers {
  private readonly meta: FileMeta;
  private readonly table: WordTable;
  private readonly coordinates: Float32Array;
  /** One over the length of each feature; NaN where never seen. */
  private readonly inverse: Float32Array;
  private readonly words: Float32Array;
  private readonly urls = new Map<number, string>();

  constructor(
    private readonly container: Container<FileMeta>,
    private readonly scene: Scene,
  ) {
    this.meta = container.meta;
    this.table = new WordTable(this.meta.words);
    this.coordinates = decodeCoordinates(container);
    this.words = Float32Array.from(arrayOf(container, "wordVectors", Int16Array), (value) => value * WORD_STEP);
    const { count, rank, floor } = this.meta;
    this.inverse = new Float32Array(count).fill(NaN);
    const seen = arrayOf(container, "seen", Uint8Array);
    for (let row = 0; row < count; row++) {
      if (!((seen[row >> 3] ?? 0) & (128 >> (row & 7)))) continue;
      let square = floor;
      for (let number = 0; number < rank; number++) square += (this.coordinates[row * rank + number] ?? 0) ** 2;
      this.inverse[row] = 1 / Math.sqrt(square);
    }
  }

  private vector(word: number): Float32Array {
    return this.words.subarray(word * this.meta.rank, (word + 1) * this.meta.rank);
  }

  relevancy(word: number): Float32Array {
    const { count, rank } = this.meta;
    const { coordinates, inverse } = this;
    const vector = this.vector(word);
    const cosines = new Float32Array(count);
    for (let row = 0, at = 0; row < count; row++) {
      let sum = 0;
      for (let number = 0; number < rank; number++, at++) sum += (coordinates[at] as number) * (vector[number] as number);
      cosines[row] = Math.max(-1, Math.min(1, sum * (inverse[row] as number)));
    }
    return cosines;
  }

  async ask(word: string): Promise<Answer> {
    const { threshold } = this.answer(word);
    return { word, relevancy: this.relevancy(this.table.find(word) as number), threshold };
  }

  private answer(word: string): FileMeta["answers"][number] {
    const answer = this.meta.answers[this.table.find(word) ?? -1];
    if (answer) return answer;
    const near = this.table.near(word, 6);
    const hint = near.length ? ` Near: ${near.join(", ")}.` : "";
    throw new Error(`“${word}” is not among the ${this.meta.words.length} words of this file.${hint}`);
  }

  async boxes(word: string): Promise<Found> {
    return foundOf(this.answer(word), this.meta.origin);
  }

  async bestWords(rows: number[]): Promise<[string, number][]> {
    const seen = rows.filter((row) => !Number.isNaN(this.inverse[row] ?? NaN));
    if (!seen.length) return [];
    const direction = this.meanDirection(Int32Array.from(seen));
    const cosines = this.meta.words.map((name, word): [string, number] => [name, this.dot(word, direction)]);
    return cosines.sort((a, b) => b[1] - a[1]).slice(0, 5);
  }

  async labels(): Promise<Labels> {
    return { names: this.meta.labels, numbers: arrayOf(this.container, "labels", Uint16Array) };
  }

  async photograph(view: number): Promise<string | null> {
    const place = this.meta.photographViews.indexOf(view);
    if (place < 0) return null;
    let url = this.urls.get(view);
    if (!url) {
      const begin = this.meta.photographSizes.slice(0, place).reduce((sum, size) => sum + size, 0);
      const bytes = arrayOf(this.container, "photographs", Uint8Array).slice(
        begin,
        begin + (this.meta.photographSizes[place] ?? 0),
      );
      url = URL.createObjectURL(new Blob([bytes], { type: "image/jpeg" }));
      this.urls.set(view, url);
    }
    return url;
  }

  private dot(word: number, direction: Float32Array): number {
    return this.vector(word).reduce((sum, value, number) => sum + value * (direction[number] ?? 0), 0);
  }

  private meanDirection(rows: Int32Array): Float32Array {
    const { rank } = this.meta;
    const mean = new Float32Array(rank);
    let total = 0;
    for (const row of rows) {
      const weight = this.scene.weight(row);
      total += weight;
      const factor = weight * (this.inverse[row] ?? 0);
      for (let number = 0; number < rank; number++) {
        mean[number] = (mean[number] ?? 0) + factor * (this.coordinates[row * rank + number] ?? 0);
      }
    }
    return mean.map((value) => value / total);
  }
}
