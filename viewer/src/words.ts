// Finding a typed word in the table: gsencoder/text/table.py in JavaScript.

export function normalize(word: string): string {
  const text = word.normalize("NFKC").toLowerCase().split(/[\s_-]+/u).join(" ").trim();
  return text.replace(/^(?:a|an|the) (?=.)/u, "");
}

function singularsAndPlurals(key: string): string[] {
  const forms: string[] = [];
  const endings: [string, string][] = [["ies", "y"], ["ves", "f"], ["ves", "fe"], ["es", ""], ["s", ""]];
  for (const [ending, singular] of endings) {
    if (key.endsWith(ending) && key.length > ending.length + 1 && !key.endsWith("ss")) {
      forms.push(key.slice(0, -ending.length) + singular);
    }
  }
  forms.push(`${key}s`, `${key}es`);
  if (key.endsWith("y")) forms.push(`${key.slice(0, -1)}ies`);
  if (key.endsWith("fe")) forms.push(`${key.slice(0, -2)}ves`);
  if (key.endsWith("f")) forms.push(`${key.slice(0, -1)}ves`);
  return forms;
}

export class WordTable {
  private readonly rowOf = new Map<string, number>();

  constructor(readonly names: string[]) {
    names.forEach((name, row) => this.rowOf.set(normalize(name), row));
  }

  find(word: string): number | null {
    const key = normalize(word);
    for (const form of [key, ...singularsAndPlurals(key)]) {
      const row = this.rowOf.get(form);
      if (row !== undefined) return row;
    }
    return null;
  }

  /** Names that share the beginning of a word with what was typed. */
  near(word: string, count: number): string[] {
    const key = normalize(word);
    const parts = key.split(" ").filter((part) => part.length > 2);
    const shares = (name: string): boolean => parts.some((part) => name.toLowerCase().includes(part.slice(0, 4)));
    return this.names.filter(shares).slice(0, count);
  }
}
