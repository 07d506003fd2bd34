// What the page holds: numbers as base64, turned into typed arrays when they are needed.

const page = JSON.parse(document.getElementById("page-data").textContent);

const element = (id) => document.getElementById(id);

function make(tag, properties = {}, ...children) {
    const made = Object.assign(document.createElement(tag), properties);
    made.append(...children);
    return made;
}

function bytes(text) {
    const letters = atob(text);
    const found = new Uint8Array(letters.length);
    for (let i = 0; i < letters.length; i++) found[i] = letters.charCodeAt(i);
    return found;
}

const floats = (text) => new Float32Array(bytes(text).buffer);
const doubles = (text) => new Float64Array(bytes(text).buffer);
const integers = (text) => new Uint32Array(bytes(text).buffer);

// low + step level, see page_arrays.py; a constant has no levels.
function coordinates(packed, count) {
    const found = new Float64Array(count).fill(packed.low);
    if (packed.levels) integers(packed.levels).forEach((level, i) => { found[i] += packed.step * level; });
    return found;
}

// Index of the value nearest to a wanted one in an increasing array.
function nearest(values, wanted) {
    const after = firstFrom(values, wanted);
    if (after === 0) return 0;
    if (after === values.length) return values.length - 1;
    return values[after] - wanted < wanted - values[after - 1] ? after : after - 1;
}

// Index of the first value that is not below a wanted one.
function firstFrom(values, wanted) {
    let [low, high] = [0, values.length];
    while (low < high) {
        const middle = (low + high) >> 1;
        if (values[middle] < wanted) low = middle + 1;
        else high = middle;
    }
    return low;
}

// A number for people: four digits, a true minus.
function spoken(value, digits = 4) {
    if (value === 0 || Math.abs(value) < 1e-9) return "0";
    const size = Math.floor(Math.log10(Math.abs(value)));
    const text = size < -4 || size > 6
        ? value.toExponential(2)
        : value.toFixed(Math.max(0, Math.min(5, digits - 1 - Math.max(size, 0))));
    return text.replace("-", "\u2212");
}

// Round values that divide a span into about `count` parts; two at least.
function ticks(low, high, count) {
    const rough = (high - low) / Math.max(count, 1);
    const decade = 10 ** Math.floor(Math.log10(rough));
    const steps = [10, 5, 2.5, 2, 1, 0.5].map((x) => x * decade);
    let step = steps.filter((x) => x >= rough * (1 - 1e-9)).pop();
    const inside = () => Math.floor(high / step + 1e-9) - Math.ceil(low / step - 1e-9) + 1;
    while (inside() < 2) step = steps[steps.indexOf(step) + 1] || step / 2;
    const found = Array.from({ length: inside() }, (_, i) => (Math.ceil(low / step - 1e-9) + i) * step);
    const whole = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
    const exact = Math.abs(step * 10 ** whole - Math.round(step * 10 ** whole)) < 1e-6;
    const decimals = exact ? whole : whole + 1;
    const long = Math.max(Math.abs(low), Math.abs(high)) >= 1e6 || decimals > 5;
    const text = (x) => {
        const value = Math.abs(x) < step / 1e3 ? 0 : x;
        return (long && value ? value.toExponential(1) : value.toFixed(decimals)).replace("-", "\u2212");
    };
    return { values: found, text };
}
