//! What corners and faces of an OBJ carry: texture coordinates, normals, materials, groups. Read in order, twice: values and
//! names first, then faces.

use super::ascii::number;
use super::lines::{Wrong, integer, unexpected, words};
use super::map::Input;
use super::obj::ObjText;
use crate::error::Result;
use crate::mesh::coat::{Coat, Corners, NOTHING, Patch};
use crate::progress::Progress;
use rustc_hash::FxHashMap;

/// What the faces that follow belong to.
#[derive(Default)]
struct State {
    patches: FxHashMap<Patch, u32>,
    materials: FxHashMap<Vec<u8>, u32>,
    groups: FxHashMap<Vec<u8>, u32>,
    now: Patch,
}

impl State {
    /// Takes note of a line that says what faces belong to. Names are numbered as they come.
    fn note(&mut self, line: &[u8]) -> Option<Named> {
        let (word, name) = parted(line);
        let (names, is_group) = match word {
            b"usemtl" => (&mut self.materials, false),
            b"g" | b"o" => (&mut self.groups, true),
            _ => return None,
        };
        let name = if word == b"o" { [b"o ", name].concat() } else { name.to_vec() };
        let next = names.len() as u32;
        let number = *names.entry(name.clone()).or_insert(next);
        *(if is_group { &mut self.now.group } else { &mut self.now.material }) = Some(number);
        Some(Named { is_group, is_new: number == next, name })
    }

    fn patch(&mut self) -> (u32, bool) {
        let next = self.patches.len() as u32;
        match self.patches.get(&self.now) {
            Some(number) => (*number, false),
            None => {
                self.patches.insert(self.now.clone(), next);
                (next, true)
            }
        }
    }
}

struct Named {
    is_group: bool,
    is_new: bool,
    name: Vec<u8>,
}

/// A line's first word and all behind it.
fn parted(line: &[u8]) -> (&[u8], &[u8]) {
    let end = line.iter().position(u8::is_ascii_whitespace).unwrap_or(line.len());
    (&line[..end], line[end..].trim_ascii())
}

/// Values and names.
pub(super) fn coat(text: &ObjText, input: &Input, progress: &Progress) -> Result<Coat> {
    let mut coat = Coat::default();
    let mut state = State::default();
    text.in_order(input, progress, |line| {
        // What is wrong with a value is no reason to refuse a shape.
        let values = |n: usize| {
            let mut words = words(line).skip(1);
            let mut found = [0.0; 3];
            for (i, x) in found[..n].iter_mut().enumerate() {
                // Textures may be of one dimension.
                let none = if i == 1 && n == 2 { 0.0 } else { f32::NAN };
                *x = words.next().map_or(none, |word| number(word, true).map_or(f32::NAN, |x| x as f32));
            }
            found
        };
        match line {
            [b'v', b't', b' ' | b'\t', ..] => {
                let [u, v, _] = values(2);
                coat.uvs.push([u, v]);
            }
            [b'v', b'n', b' ' | b'\t', ..] => coat.normals.push(values(3)),
            [b'v', ..] => {}
            [b'f', b' ' | b'\t', ..] | [b'f', b'o', b' ' | b'\t', ..] => {
                if state.patch().1 {
                    coat.patches.push(state.now.clone());
                }
            }
            [b'm', b't', b'l', b'l', b'i', b'b', ..] => {
                coat.libraries.push(String::from_utf8_lossy(parted(line).1).into_owned());
            }
            _ => {
                if let Some(named) = state.note(line).filter(|named| named.is_new) {
                    let names = if named.is_group { &mut coat.groups } else { &mut coat.materials };
                    names.push(String::from_utf8_lossy(&named.name).into_owned());
                }
            }
        }
        Ok(())
    })?;
    Ok(coat)
}

/// Triangles, in the order of the file.
pub(super) fn corners(
    text: &ObjText,
    coat: &Coat,
    input: &Input,
    progress: &Progress,
    step: &mut dyn FnMut(Corners),
) -> Result<()> {
    let total = [text.total.vertices, coat.uvs.len() as u64, coat.normals.len() as u64];
    let mut known = [0u64; 3];
    let mut state = State::default();
    let mut polygon: Vec<[u32; 3]> = Vec::new();
    text.in_order(input, progress, |line| {
        match line {
            [b'v', b't', b' ' | b'\t', ..] => known[1] += 1,
            [b'v', b'n', b' ' | b'\t', ..] => known[2] += 1,
            [b'v', b' ' | b'\t', ..] => known[0] += 1,
            [b'f', b' ' | b'\t', ..] | [b'f', b'o', b' ' | b'\t', ..] => {
                let (patch, _) = state.patch();
                polygon.clear();
                for word in words(line).skip(1) {
                    polygon.push(corner(word, known, total)?);
                }
                if let [a, rest @ ..] = &polygon[..] {
                    for pair in rest.windows(2) {
                        let all = [*a, pair[0], pair[1]];
                        let [vertices, uvs, normals] = [0, 1, 2].map(|i| all.map(|corner| corner[i]));
                        step(Corners { vertices, uvs, normals, patch });
                    }
                }
            }
            [b'v', ..] => {}
            _ => {
                state.note(line);
            }
        }
        Ok(())
    })
}

/// The numbers of a corner, `v`, `v/vt`, `v//vn` or `v/vt/vn`, from 0 on. One of a value that is not there is none.
fn corner(word: &[u8], known: [u64; 3], total: [u64; 3]) -> Result<[u32; 3], Wrong<'_>> {
    let mut numbers = [NOTHING; 3];
    for (i, part) in word.split(|b| *b == b'/').take(3).enumerate() {
        let at = integer(part).filter(|index| *index != 0).map(|n| if n < 0 { known[i] as i64 + n } else { n - 1 });
        match at.filter(|at| *at >= 0 && (*at as u64) < total[i].min(u64::from(NOTHING))) {
            Some(at) => numbers[i] = at as u32,
            None if i == 0 => return Err(unexpected(word, "the number of a vertex first, as in 7, 7/8 or 7//9")),
            None => {}
        }
    }
    Ok(numbers)
}
