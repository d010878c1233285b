"use strict";
// What `fes explain` says of one instant, from the report alone: what the guards saw at each kept sample is in it.
const momentTeller = (data) => {
  const DIGITS = 3, OLD_S = 5;
  const words = data.moments;

  const typed = (text, Kind) => {
    const raw = atob(text), bytes = new Uint8Array(raw.length);
    for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
    return new Kind(bytes.buffer);
  };
  const feet = new Map();
  const footOf = (name) => {
    const packed = words.feet[name];
    if (packed && !feet.has(name)) {
      feet.set(name, {
        ...packed, t_s: typed(packed.t_s, Float64Array), phase: typed(packed.phase, Int8Array),
        fired: typed(packed.fired, Int8Array), holds: typed(packed.holds, Uint8Array),
        values: packed.values.map((one) => typed(one, Float32Array)),
      });
    }
    return feet.get(name);
  };

  // The last entry of a sorted list that begins at or before a value; -1 where there is none.
  const last = (count, begins, value) => {
    let low = -1, high = count - 1;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (begins(middle) <= value) low = middle; else high = middle - 1;
    }
    return low;
  };
  const newest = (list, value) => list[last(list.length, (i) => list[i][0], value)];

  // How a foot's comparisons came out at a kept sample: a function from a guard's terms to those with their values.
  const seenAt = (foot, row) => {
    const samples = foot.t_s.length, comparisons = foot.columns.length / 2, bytes = foot.holds.length / samples;
    const since = last(foot.begins.length, (i) => foot.begins[i], row), limitIs = {};
    for (const [from, changed] of foot.limit_is) if (from <= row) Object.assign(limitIs, changed);
    const value = (column) => {
      const values = foot.values[foot.columns[column]];
      return values[values.length === samples ? row : since];
    };
    const at = (terms) => {
      if (terms.parts) {
        const parts = terms.parts.map(at);
        return { every: terms.every, parts, holds: terms.every ? parts.every((e) => e.holds) : parts.some((e) => e.holds) };
      }
      const k = terms.number, seen = value(k), limit = value(comparisons + k);
      const shown = terms.flag ? { seen: Boolean(seen), limit: Boolean(limit) } : { seen, limit };
      return { ...terms, ...shown, of: limitIs[k], holds: Boolean(foot.holds[row * bytes + (k >> 3)] >> (k & 7) & 1) };
    };
    return at;
  };

  const OPPOSITE = { "<": "≥", "≥": "<", ">": "≤", "≤": ">" };
  const each = (terms) => (terms.parts ? terms.parts.flatMap(each) : [terms]);

  const yes = (flag) => (flag ? "yes" : "no");
  const short = (number) => { // as _short of statemachine/terms.py
    const size = Math.abs(number);
    if (size >= 1000) return number.toFixed(0);
    return size > 0 && size < 1e-3 ? number.toFixed(4) : String(Number(number.toPrecision(3)));
  };
  const cell = (shown) => (typeof shown === "boolean" ? yes(shown)
    : shown.toFixed(Math.abs(shown) >= 100 ? 0 : DIGITS));
  const failed = (term, sign) => (term.flag ? `${term.what}: ${yes(term.seen)}, must be ${yes(term.limit)}`
    : `${term.what} ${short(term.seen)} ${sign} ${short(term.limit)} ${term.unit}`.trim());
  const asked = (part) => (!part.parts ? failed(part, part.sign)
    : part.parts.filter((each) => !each.holds).map(asked).join(part.every ? " and " : " or "));
  const whyNot = (terms) => {
    if (!terms.every) return "none of these holds: " + terms.parts.map(asked).join("; ");
    const lacking = terms.parts.filter((part) => !part.holds);
    return lacking.map((part) => (part.parts ? whyNot(part) : failed(part, OPPOSITE[part.sign]))).join(", and ");
  };

  // Sentences and rows of one foot; nothing where its guards are not known then.
  const foot = (sensor, sinceOf, at) => {
    const own = footOf(sensor), name = own && own.foot;
    const row = own ? last(own.t_s.length, (i) => own.t_s[i], at + 5e-5) : -1;
    if (row < 0 || at - own.t_s[row] > OLD_S) return null;
    const cameOut = seenAt(own, row), phase = words.phases[own.phase[row]], fired = words.transitions[own.fired[row]];
    const guards = words.guards.map((guard) => (
      { name: guard.name, asked: guard.from === phase, terms: cameOut(guard.terms) }));
    const since_s = sinceOf(own.t_s[row] - 1e-4); // of the phase that this sample found
    const since = since_s === null ? "" : ` since ${since_s.toFixed(3)} s`;
    const lines = [`The ${name} was in ${phase}${since} (sample of ${own.t_s[row].toFixed(3)} s).`];
    for (const guard of guards.filter((one) => one.asked)) {
      if (guard.name === fired) lines.push(`${guard.name} fired at this sample.`);
      else if (!guard.terms.holds) lines.push(`${guard.name} did not fire: ${whyNot(guard.terms)}.`);
    }
    const walking = newest(own.walking, row);
    if (walking) lines.push(`The ${name} ${walking[1]}.`);
    if (!own.same) lines.push("This program decides otherwise than the one that recorded the log: what the guards saw is this program's.");
    const rows = guards.flatMap((guard) => each(guard.terms).map((term) => (
      { asked: guard.asked, cells: [name, guard.name, term.holds ? "✓" : "·", term.what, cell(term.seen), term.sign, cell(term.limit), term.unit, term.of] })));
    return { lines, rows };
  };

  // Why a channel that was off was so; "" where it is not known.
  const off = (name, phaseOf, at) => {
    const channel = words.channels[name];
    const refused = newest(channel.refused, at);
    if (refused && (refused[1] === null || at < refused[1])) return `, the gate refused it: ${refused[3]}`;
    const lately = refused && at - refused[1] < 2 ? ` Refused at ${refused[0].toFixed(3)} s: ${refused[2]}.` : "";
    const phase = phaseOf(channel.sensor);
    if (!phase) return lately && "." + lately;
    if (!channel.phases.includes(phase.number)) {
      return `, for the ${channel.foot} was in ${words.phases[phase.number]}; it is stimulated in ${channel.window}.${lately}`;
    }
    const intensity = newest(words.intensity, at);
    if (intensity && intensity[1] <= 0) return ", for the intensity was 0." + lately;
    const own = footOf(channel.sensor);
    const said = own && newest(own.walking, last(own.t_s.length, (i) => own.t_s[i], phase.start_s + 5e-5));
    if (said && !said[1].startsWith("walks")) {
      return `, for when ${words.phases[phase.number]} began at ${phase.start_s.toFixed(3)} s the ${channel.foot} was ${said[1]}.${lately}`;
    }
    return ", for its burst had not begun yet, was over, or was not permitted when the phase began." + lately;
  };

  const tuned = (at) => {
    const own = data.notices.filter((one) => one.source === "tuning" && one.time_s <= at).pop();
    return own ? [`Tuning, ${own.time_s.toFixed(2)} s: ${own.text}`] : [];
  };

  return { foot, off, tuned, gate: (at) => newest(words.gate, at)[1] };
};
