// Answers of a page that is one file: cosines from quantized coordinates, and the probability of boxes.

import { arrayOf, type Container } from "./container";
import type { Scene } from "./scene";
import { background, bestOf, thresholdOf } from "./threshold";
import type { Answer, Answers, Coefficients, FileMeta, FoundBox, Judged, Labels } from "./types";
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
    const row = this.table.find(word);
    if (row === null) {
      const near = this.table.near(word, 6);
      const hint = near.length ? ` Near: ${near.join(", ")}.` : "";
      throw new Error(`“${word}” is not among the ${this.meta.words.length} words of this file.${hint}`);
    }
    const relevancy = this.relevancy(row);
    return { word, relevancy, threshold: thresholdOf(relevancy, this.meta.localize.threshold) };
  }

  async judge(answer: Answer, found: FoundBox[]): Promise<Judged> {
    const row = this.table.find(answer.word);
    if (row === null) return { boxes: found, probability: 0 };
    const { median, spread } = background(answer.relevancy);
    const trained = this.meta.trained?.[row];
    const kinds = this.meta.presence;
    const coefficients = trained === undefined ? kinds.unknown : trained ? kinds.trained : kinds.untrained;
    const synonyms = new Set([row, ...(this.meta.synonyms[String(row)] ?? [])]);
    const total = (rows: Int32Array): number => rows.reduce((sum, each) => sum + this.scene.weight(each), 0);
    let all = 0;
    const cutoff = answer.threshold ?? Infinity;
    answer.relevancy.forEach((value, each) => {
      if (value >= cutoff) all += this.scene.weight(each);
    });
    const judged = found.map((box): FoundBox => {
      const rows = box.rows ?? new Int32Array();
      const direction = this.meanDirection(rows);
      const mean = Math.min(this.dot(row, direction), 1);
      let rival = -Infinity;
      for (let other = 0; other < this.meta.words.length; other++) {
        if (!synonyms.has(other)) rival = Math.max(rival, this.dot(other, direction));
      }
      const best = bestOf(Float32Array.from(rows, (each) => answer.relevancy[each] ?? 0));
      const height = (best - median) / Math.max(spread, kinds.smallestSpread);
      const evidence: Coefficients = {
        mean,
        margin: mean - rival,
        prominence: Math.log(Math.max(height, 1e-3)),
        size: Math.log10(rows.length),
        share: total(rows) / all,
      };
      let logit = coefficients.intercept ?? 0;
      for (const [name, value] of Object.entries(evidence)) {
        if (Number.isFinite(value)) logit += (coefficients[name] ?? 0) * value;
      }
      return { ...box, probability: 0.5 * (1 + Math.tanh(logit / 2)) };
    });
    const probability = Math.max(0, ...judged.map((box) => box.probability ?? 0));
    const boxes = judged.filter((box) => (box.probability ?? 0) >= this.meta.localize.minProbability);
    return { boxes, probability };
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
