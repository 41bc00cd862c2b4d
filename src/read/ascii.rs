//! Words and numbers of text files.

use super::cursor::Cursor;
use super::ply_header::shown;
use super::ply_records::{Fault, Values, no_such_vertex};
use crate::error::Result;
use crate::mesh::columns::Number;

/// The longest word that is looked at.
const WORD_BYTES: usize = 256;

/// The words of a text, wherever its lines end.
#[derive(Debug)]
pub(super) struct Words<'a> {
    cursor: Cursor<'a>,
}

#[inline(always)]
fn is_space(byte: u8) -> bool {
    matches!(byte, b' ' | b'\t' | b'\n' | b'\r' | 0x0b | 0x0c)
}

impl<'a> Words<'a> {
    /// The words from the cursor on.
    pub fn new(cursor: Cursor<'a>) -> Self {
        Words { cursor }
    }

    /// One past the last word taken, or where the next one begins if it was peeked at.
    pub fn at(&self) -> u64 {
        self.cursor.at
    }

    /// Moves to the beginning of the next word and returns it without taking it; `None` at the end of the file.
    #[inline]
    pub fn peek(&mut self) -> Result<Option<&[u8]>, Fault> {
        skip_space(&mut self.cursor)?;
        let bytes = self.cursor.bytes(WORD_BYTES + 1)?;
        let len = bytes.iter().take(WORD_BYTES + 1).position(|&b| is_space(b)).unwrap_or(bytes.len());
        if len > WORD_BYTES {
            let begin = shown(&String::from_utf8_lossy(&bytes[..80]));
            return Err(Fault::Wrong(self.cursor.at, format!("`{begin}` is no number and no keyword")));
        }
        Ok(if len == 0 { None } else { Some(&self.cursor.bytes(0)?[..len]) })
    }

    /// Takes the next word.
    #[inline]
    pub fn next(&mut self) -> Result<Option<(u64, &[u8])>, Fault> {
        let Some(len) = self.peek()?.map(<[u8]>::len) else { return Ok(None) };
        let at = self.cursor.at;
        self.cursor.at += len as u64;
        Ok(Some((at, self.cursor.behind(len))))
    }

    /// Passes over the rest of the line.
    pub fn skip_line(&mut self) -> Result<(), Fault> {
        loop {
            let bytes = self.cursor.bytes(1)?;
            let end = bytes.iter().position(|b| matches!(b, b'\n' | b'\r'));
            let len = end.unwrap_or(bytes.len());
            self.cursor.at += len as u64;
            if end.is_some() || len == 0 {
                return Ok(());
            }
        }
    }
}

/// A whole number, also one written with a fraction of zeros.
fn integer(word: &[u8]) -> Option<i64> {
    let digits = match word {
        [b'-' | b'+', digits @ ..] => digits,
        digits => digits,
    };
    if !digits.is_empty() && digits.len() <= 18 && digits.iter().all(u8::is_ascii_digit) {
        let n = digits.iter().fold(0, |n, d| n * 10 + i64::from(d - b'0'));
        return Some(if word[0] == b'-' { -n } else { n });
    }
    let number: f64 = fast_float2::parse(word).ok()?;
    (number.fract() == 0.0 && number.abs() < 9e15).then_some(number as i64)
}

/// A number as the file stores it: what is declared `float` is rounded to one.
pub(super) fn number(word: &[u8], single: bool) -> Option<f64> {
    if single { fast_float2::parse::<f32, _>(word).ok().map(f64::from) } else { fast_float2::parse(word).ok() }
}

/// Values of an ASCII PLY file.
pub(super) struct Ascii<'a>(Words<'a>);

impl Ascii<'_> {
    #[inline]
    fn parse<T>(&mut self, parse: impl Fn(&[u8]) -> Option<T>, expected: &str) -> Result<(u64, T), Fault> {
        let (at, word) = self.0.next()?.ok_or(Fault::End)?;
        parse(word).map(|number| (at, number)).ok_or_else(|| {
            let word = shown(&String::from_utf8_lossy(word));
            Fault::Wrong(at, format!("`{word}`, expected {expected}"))
        })
    }
}

impl<'a> Values<'a> for Ascii<'a> {
    fn new(cursor: Cursor<'a>) -> Self {
        Ascii(Words::new(cursor))
    }

    fn at(&self) -> u64 {
        self.0.at()
    }

    fn number(&mut self, kind: Number) -> Result<f64, Fault> {
        self.parse(|word| number(word, kind == Number::F32), "a number").map(|(_, number)| number)
    }

    fn integer(&mut self, _: Number) -> Result<i64, Fault> {
        self.parse(integer, "a whole number").map(|(_, number)| number)
    }

    fn indices(&mut self, _: Number, n: usize, limit: u64, corners: &mut Vec<u32>) -> Result<(), Fault> {
        for _ in 0..n {
            let (at, index) = self.parse(integer, "a vertex index")?;
            if index < 0 || index as u64 >= limit.min(1 << 32) {
                return Err(Fault::Wrong(at, no_such_vertex(index, limit)));
            }
            corners.push(index as u32);
        }
        Ok(())
    }

    fn skip(&mut self, _: Number, n: u64) -> Result<(), Fault> {
        for _ in 0..n {
            self.0.next()?.ok_or(Fault::End)?;
        }
        Ok(())
    }

    fn skip_zeros(&mut self, _: Number, _: u64) -> Result<u64, Fault> {
        Ok(0)
    }
}

/// Moves a cursor to the next byte that is no white space.
pub(super) fn skip_space(cursor: &mut Cursor<'_>) -> Result<()> {
    loop {
        let bytes = cursor.bytes(1)?;
        let skip = bytes.iter().position(|&b| !is_space(b));
        let len = skip.unwrap_or(bytes.len());
        cursor.at += len as u64;
        if skip.is_some() || len == 0 {
            return Ok(());
        }
    }
}
