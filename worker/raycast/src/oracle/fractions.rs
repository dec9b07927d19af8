//! `cast` finds the cell that rational arithmetic finds.
//!
//! Heights, layers, starts and directions are small integers, so over one cell the height
//! of the ray above the surface, times the area of the cell, is a quadratic with integer
//! coefficients, lines are crossed at fractions, and every comparison is decided exactly.
//! Where the ray goes through the surface, the answer is unique. Where it touches the
//! surface in a point and no more (a post, a line between two cells, a tangent), rounding
//! may decide either way: then the cells that are touched before the ray goes through
//! count, too. Rounding may not decide about a start on the surface (it hits at once) nor
//! about a ray along a line of the grid (it is in the cell to the east or north).

use super::{Dice, Land, count};
use crate::tests_support::Plan;
use glam::DVec3;
use std::cmp::Ordering;
use terrafarm_common::quality::Method;

const RAYS: u64 = 60_000;
const RAYS_A_LAND: u64 = 60;
/// In units of the direction, beyond every land.
const END: Fraction = Fraction { over: 1000, under: 1 };

/// over / under, under > 0.
#[derive(Debug, Clone, Copy)]
struct Fraction {
    over: i128,
    under: i128,
}

impl Fraction {
    fn new(over: i64, under: i64) -> Self {
        let sign = i128::from(under.signum());
        Fraction { over: i128::from(over) * sign, under: i128::from(under) * sign }
    }

    fn compare(&self, other: &Fraction) -> Ordering {
        (self.over * other.under).cmp(&(other.over * self.under))
    }

    fn middle(a: Fraction, b: Fraction) -> Fraction {
        Fraction { over: a.over * b.under + b.over * a.under, under: 2 * a.under * b.under }
    }

    fn value(&self) -> f64 {
        self.over as f64 / self.under as f64
    }
}

/// a t^2 + b t + c.
#[derive(Debug, Clone, Copy)]
struct Quadratic {
    a: i128,
    b: i128,
    c: i128,
}

/// What happens over one piece of a ray.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Meeting {
    Apart,
    /// At or below the surface somewhere, but nowhere below.
    Touches,
    Crosses,
}

impl Quadratic {
    fn sign(&self, t: Fraction) -> Ordering {
        let value =
            self.a * t.over * t.over + self.b * t.over * t.under + self.c * t.under * t.under;
        value.cmp(&0)
    }

    fn meeting(&self, start: Fraction, end: Fraction) -> Meeting {
        let mut least = self.sign(start).min(self.sign(end));
        if self.a > 0 {
            let lowest = Fraction { over: -self.b, under: 2 * self.a };
            if lowest.compare(&start).is_gt() && lowest.compare(&end).is_lt() {
                least = least.min((4 * self.a * self.c).cmp(&(self.b * self.b)));
            }
        }
        match least {
            Ordering::Less => Meeting::Crosses,
            Ordering::Equal => Meeting::Touches,
            Ordering::Greater => Meeting::Apart,
        }
    }

    /// The first t from `start` at which it is not positive, rounded; with the next one if
    /// it is zero right at `start`, where the ray may be said to slip by.
    fn first_zeros(&self, start: Fraction, end: Fraction) -> Vec<f64> {
        let mut found = Vec::new();
        if self.sign(start).is_le() {
            found.push(start.value());
        }
        if self.sign(start).is_lt() {
            return found;
        }
        let (a, b, c) = (self.a as f64, self.b as f64, self.c as f64);
        let root = (b * b - 4.0 * a * c).max(0.0).sqrt();
        let zeros = [(-b - root) / (2.0 * a), (-b + root) / (2.0 * a), -c / b];
        let zeros = if self.a == 0 { &zeros[2..] } else { &zeros[..2] };
        let low = start.value() + if found.is_empty() { -1e-9 } else { 1e-9 };
        let inside = |t: &f64| (low..=end.value() + 1e-9).contains(t);
        let next = zeros.iter().copied().filter(inside).fold(f64::INFINITY, f64::min);
        found.extend(next.is_finite().then_some(next));
        found
    }
}

#[derive(Debug)]
struct Layer {
    origin: [i64; 2],
    spacing: [i64; 2],
    posts: [i64; 2],
    heights: Vec<Option<i64>>,
}

#[derive(Debug, Clone, Copy)]
struct Ray {
    start: [i64; 3],
    direction: [i64; 3],
}

/// A cell that may be the answer: (layer, i, j), and from where to where the ray may be
/// said to meet it, in units of the direction: a range only if it runs in the surface.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Answer {
    cell: (usize, i64, i64),
    from: f64,
    to: f64,
}

impl Layer {
    fn random(dice: &mut Dice, inset: bool) -> Layer {
        let spacing = match dice.below(4) {
            0 => [1, 1],
            1 => [2, 2],
            2 => [3, 1],
            _ => [2, 4],
        };
        let most = if inset { 5 } else { 9 };
        let posts = [dice.whole(2, most), dice.whole(2, most)];
        let relief = [0, 2, 6, 30][dice.below(4) as usize];
        let holes = dice.below(3) == 0;
        let heights = (0..posts[0] * posts[1]).map(|_| {
            let void = holes && dice.below(9) == 0;
            (!void).then(|| dice.whole(-relief, relief))
        });
        let heights = heights.collect();
        Layer { origin: [dice.whole(-4, 4), dice.whole(-4, 4)], spacing, posts, heights }
    }

    fn plan(&self) -> Plan {
        let numbers = |pair: [i64; 2]| pair.map(|number| number as f64);
        let posts = self.posts.map(|number| number as u64);
        Plan::heights(numbers(self.origin), numbers(self.spacing), posts, |i, j| {
            self.post(i as i64, j as i64).map_or(f32::NAN, |height| height as f32)
        })
    }

    fn post(&self, i: i64, j: i64) -> Option<i64> {
        self.heights[(j * self.posts[0] + i) as usize]
    }

    fn cells(&self) -> [i64; 2] {
        self.posts.map(|posts| posts - 1)
    }

    /// Height of the ray above the surface of a cell, times the cell's area.
    fn gap(&self, ray: &Ray, [i, j]: [i64; 2]) -> Option<Quadratic> {
        let corners = [(i, j), (i + 1, j), (i, j + 1), (i + 1, j + 1)];
        let [sw, se, nw, ne] = corners.map(|(i, j)| self.post(i, j).map(i128::from));
        let (sw, se, nw, ne) = (sw?, se?, nw?, ne?);
        let from = |axis: usize, index: i64| {
            i128::from(ray.start[axis] - self.origin[axis] - index * self.spacing[axis])
        };
        let (x, y) = (from(0, i), from(1, j));
        let [dx, dy, dz] = ray.direction.map(i128::from);
        let [width, depth] = self.spacing.map(i128::from);
        let (east, north, twist) = (se - sw, nw - sw, sw - se - nw + ne);
        let (start, area) = (i128::from(ray.start[2]), width * depth);
        Some(Quadratic {
            a: -twist * dx * dy,
            b: area * dz - east * depth * dx - north * width * dy - twist * (x * dy + y * dx),
            c: area * (start - sw) - east * depth * x - north * width * y - twist * x * y,
        })
    }

    /// Where the ray crosses a line of an axis.
    fn crossing(&self, ray: &Ray, axis: usize, line: i64) -> Option<Fraction> {
        let way = self.origin[axis] + line * self.spacing[axis] - ray.start[axis];
        let rate = ray.direction[axis];
        (rate != 0).then(|| Fraction::new(way, rate))
    }

    /// The cell over which the ray is at `t`, by the rule of lines for a ray along one.
    fn cell_at(&self, ray: &Ray, t: Fraction) -> Option<[i64; 2]> {
        let mut cell = [0; 2];
        for (axis, index) in cell.iter_mut().enumerate() {
            let from = i128::from(ray.start[axis] - self.origin[axis]);
            let over = from * t.under + i128::from(ray.direction[axis]) * t.over;
            let under = t.under * i128::from(self.spacing[axis]);
            let last = i128::from(self.cells()[axis]);
            if over < 0 || over > last * under {
                return None;
            }
            *index = (over.div_euclid(under)).min(last - 1) as i64;
        }
        Some(cell)
    }

    /// Whether the point of the ray at `t` is within the layer and not on its border.
    fn covers(&self, ray: &Ray, t: Fraction) -> bool {
        (0..2).all(|axis| {
            let from = i128::from(ray.start[axis] - self.origin[axis]);
            let over = from * t.under + i128::from(ray.direction[axis]) * t.over;
            over > 0 && over < t.under * i128::from(self.cells()[axis] * self.spacing[axis])
        })
    }

    /// All cells that the point of the ray at `t` belongs to, borders included.
    fn cells_around(&self, ray: &Ray, t: Fraction) -> Vec<[i64; 2]> {
        let ranges = [0, 1].map(|axis| {
            let from = i128::from(ray.start[axis] - self.origin[axis]);
            let over = from * t.under + i128::from(ray.direction[axis]) * t.over;
            let under = t.under * i128::from(self.spacing[axis]);
            let index = over.div_euclid(under) as i64;
            let first = if over.rem_euclid(under) == 0 { index - 1 } else { index };
            first.max(0)..=index.min(self.cells()[axis] - 1)
        });
        let [columns, rows] = ranges;
        rows.flat_map(|j| columns.clone().map(move |i| [i, j])).collect()
    }
}

/// The cells that the ray may be said to meet, in order, and whether the last one is met
/// for certain.
fn answers(layers: &[Layer], ray: &Ray) -> (Vec<Answer>, bool) {
    let mut events = vec![(Fraction::new(0, 1), None), (END, None)];
    for (number, layer) in layers.iter().enumerate() {
        for axis in 0..2 {
            for line in 0..layer.posts[axis] {
                let border = line == 0 || line == layer.cells()[axis];
                let of_layer = border.then_some(number);
                let crossing = layer.crossing(ray, axis, line).filter(|t| t.over > 0);
                events.extend(crossing.map(|t| (t, Some((axis, of_layer)))));
            }
        }
    }
    events.sort_by(|(a, _), (b, _)| a.compare(b));
    let mut found = Vec::new();
    for pair in events.windows(2) {
        let ((start, line), (end, next_line)) = (pair[0], pair[1]);
        if start.compare(&end).is_eq() {
            // Lines of both axes or borders of two layers at once: for a rounding error
            // the ray may be in one of the cells beside.
            if line != next_line {
                found.extend(beside(layers, ray, start));
            }
            continue;
        }
        let middle = Fraction::middle(start, end);
        let over = |(number, layer): (usize, &Layer)| Some((number, layer.cell_at(ray, middle)?));
        let Some((number, cell)) = layers.iter().enumerate().rev().find_map(over) else { continue };
        let Some(gap) = layers[number].gap(ray, cell) else { continue };
        let powers_of_two = layers[number].spacing.iter().all(|step| step.count_ones() == 1);
        let at_once = start.over == 0 && gap.sign(start).is_le() && powers_of_two;
        let meeting = gap.meeting(start, end);
        if meeting == Meeting::Apart {
            continue;
        }
        let zeros = gap.first_zeros(start, end);
        let zeros = if at_once { &zeros[..1] } else { &zeros };
        let within = (gap.a, gap.b, gap.c) == (0, 0, 0) && !at_once;
        let cell = (number, cell[0], cell[1]);
        let to = |from: f64| if within { end.value() } else { from };
        found.extend(zeros.iter().map(|&from| Answer { cell, from, to: to(from) }));
        if at_once || meeting == Meeting::Crosses {
            return (found, true);
        }
    }
    (found, false)
}

fn beside(layers: &[Layer], ray: &Ray, t: Fraction) -> Vec<Answer> {
    let mut found = Vec::new();
    for (number, layer) in layers.iter().enumerate() {
        if layers[number + 1..].iter().any(|later| later.covers(ray, t)) {
            continue;
        }
        for cell in layer.cells_around(ray, t) {
            if layer.gap(ray, cell).is_some_and(|gap| gap.sign(t).is_le()) {
                let (from, cell) = (t.value(), (number, cell[0], cell[1]));
                found.push(Answer { cell, from, to: from });
            }
        }
    }
    found
}

/// A ray from anywhere, in half of all cases through a place of whole coordinates that
/// lies on the surface or right beside it.
fn random_ray(layers: &[Layer], dice: &mut Dice) -> Ray {
    let start = [dice.whole(-9, 20), dice.whole(-9, 24), dice.whole(-8, 35)];
    let direction = if dice.below(2) == 0 {
        let layer = &layers[dice.below(layers.len() as u64) as usize];
        let [i, j] = layer.posts.map(|posts| dice.whole(0, posts - 1));
        let shift = [0, 0, 0, 1][dice.below(4) as usize];
        let place = [
            layer.origin[0] + i * layer.spacing[0] + shift,
            layer.origin[1] + j * layer.spacing[1],
            layer.post(i, j).unwrap_or(0),
        ];
        [0, 1, 2].map(|axis| place[axis] - start[axis])
    } else {
        [dice.whole(-4, 4), dice.whole(-4, 4), dice.whole(-5, 2)]
    };
    let direction = if direction == [0; 3] { [0, 0, -1] } else { direction };
    Ray { start, direction }
}

#[test]
fn cast_finds_the_cells_of_rational_arithmetic() {
    let mut dice = Dice::new(31_000_000_000);
    let (mut unique, mut ties, mut hits) = (0, 0, 0);
    for _ in 0..count(RAYS) / RAYS_A_LAND {
        let mut layers = vec![Layer::random(&mut dice, false)];
        if dice.below(3) == 0 {
            layers.push(Layer::random(&mut dice, true));
        }
        let land = Land::new("whole numbers", layers.iter().map(Layer::plan).collect());
        for _ in 0..RAYS_A_LAND {
            let ray = random_ray(&layers, &mut dice);
            let (expected, certain) = answers(&layers, &ray);
            let [start, direction] = [ray.start, ray.direction]
                .map(|[x, y, z]| DVec3::new(x as f64, y as f64, z as f64));
            for method in [Method::Exact, Method::Reference] {
                let hit = land.cast(method, None, start, direction);
                let fits = match &hit {
                    None => !certain,
                    Some(hit) => expected.iter().any(|answer| {
                        let t = hit.distance_m / direction.length();
                        answer.cell == (hit.layer, hit.i as i64, hit.j as i64)
                            && (answer.from - 1e-7..=answer.to + 1e-7).contains(&t)
                    }),
                };
                assert!(fits, "{method}: {ray:?} over {layers:?}: {hit:?}, not {expected:?}");
                hits += u64::from(hit.is_some());
            }
            let range = expected.iter().any(|answer| answer.from < answer.to);
            let one = expected.len() == usize::from(certain) && !range;
            (unique, ties) = if one { (unique + 1, ties) } else { (unique, ties + 1) };
        }
    }
    println!("{unique} rays with one answer, {ties} with several; {hits} hits by two methods");
    assert!(unique > 2 * ties && ties > unique / 10, "{unique} {ties}");
    assert!(hits > unique / 2, "{hits}");
}
