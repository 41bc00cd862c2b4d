//! What vertices carry beside their positions: numbers, by the file's own names and types.

/// The type of a number in a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(missing_docs)]
pub enum Number {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Number {
    /// What PLY calls it.
    pub fn word(self) -> &'static str {
        match self {
            Number::I8 => "char",
            Number::U8 => "uchar",
            Number::I16 => "short",
            Number::U16 => "ushort",
            Number::I32 => "int",
            Number::U32 => "uint",
            Number::F32 => "float",
            Number::F64 => "double",
        }
    }

    /// Whether it is a whole one.
    pub fn is_integer(self) -> bool {
        !matches!(self, Number::F32 | Number::F64)
    }

    /// Bytes of one in a binary file.
    pub fn bytes(self) -> usize {
        match self {
            Number::I8 | Number::U8 => 1,
            Number::I16 | Number::U16 => 2,
            Number::I32 | Number::U32 | Number::F32 => 4,
            Number::F64 => 8,
        }
    }

    /// Whether `f32` holds every value.
    pub fn fits_f32(self) -> bool {
        !matches!(self, Number::I32 | Number::U32 | Number::F64)
    }

    /// One more than the largest value that it can hold as an index.
    pub fn index_limit(self) -> u64 {
        match self {
            Number::I8 => 1 << 7,
            Number::U8 => 1 << 8,
            Number::I16 => 1 << 15,
            Number::U16 => 1 << 16,
            Number::I32 => 1 << 31,
            _ => 1 << 32,
        }
    }

    /// The number that little-endian bytes begin with, which are as many as it has.
    #[inline]
    pub fn get(self, bytes: &[u8]) -> f64 {
        fn first<const N: usize>(bytes: &[u8]) -> [u8; N] {
            bytes.first_chunk().copied().unwrap_or([0; N])
        }
        match self {
            Number::I8 => f64::from(i8::from_le_bytes(first(bytes))),
            Number::U8 => f64::from(u8::from_le_bytes(first(bytes))),
            Number::I16 => f64::from(i16::from_le_bytes(first(bytes))),
            Number::U16 => f64::from(u16::from_le_bytes(first(bytes))),
            Number::I32 => f64::from(i32::from_le_bytes(first(bytes))),
            Number::U32 => f64::from(u32::from_le_bytes(first(bytes))),
            Number::F32 => f64::from(f32::from_le_bytes(first(bytes))),
            Number::F64 => f64::from_le_bytes(first(bytes)),
        }
    }

    /// Appends `x` in little-endian bytes; what an integer cannot hold is clamped to what it can.
    #[inline]
    pub fn put(self, x: f64, out: &mut Vec<u8>) {
        match self {
            Number::I8 => out.extend((x.round() as i8).to_le_bytes()),
            Number::U8 => out.extend((x.round() as u8).to_le_bytes()),
            Number::I16 => out.extend((x.round() as i16).to_le_bytes()),
            Number::U16 => out.extend((x.round() as u16).to_le_bytes()),
            Number::I32 => out.extend((x.round() as i32).to_le_bytes()),
            Number::U32 => out.extend((x.round() as u32).to_le_bytes()),
            Number::F32 => out.extend((x as f32).to_le_bytes()),
            Number::F64 => out.extend(x.to_le_bytes()),
        }
    }
}

/// What a number is part of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Meaning {
    /// Red, green, blue or alpha.
    Colour(usize),
    /// A coordinate of the normal.
    Normal(usize),
    /// A coordinate of the texture, the second one upwards.
    Texture(usize),
    /// Anything else.
    Other,
}

impl Meaning {
    /// By the names that files use.
    pub fn of(name: &str) -> Meaning {
        let name = name.strip_prefix("diffuse_").unwrap_or(name);
        match name {
            "red" | "r" => Meaning::Colour(0),
            "green" | "g" => Meaning::Colour(1),
            "blue" | "b" => Meaning::Colour(2),
            "alpha" | "a" => Meaning::Colour(3),
            "nx" => Meaning::Normal(0),
            "ny" => Meaning::Normal(1),
            "nz" => Meaning::Normal(2),
            _ => Meaning::Other,
        }
    }
}

/// One number a vertex.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Column {
    /// As the file calls it.
    pub name: String,
    /// As the file stores it.
    pub number: Number,
    /// What it is part of.
    pub meaning: Meaning,
}

/// Numbers of every vertex.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Columns {
    /// What they are.
    pub columns: Vec<Column>,
    /// One of each a vertex, vertex after vertex.
    pub values: Vec<f64>,
}

impl Column {
    /// The share of full brightness that a part of a colour stands for.
    pub fn brightness(&self, value: f64) -> f64 {
        (value / self.full()).clamp(0.0, 1.0)
    }

    /// What stands for full brightness, or for one.
    pub fn full(&self) -> f64 {
        match self.number {
            Number::I8 => f64::from(i8::MAX),
            Number::U8 => f64::from(u8::MAX),
            Number::I16 => f64::from(i16::MAX),
            Number::U16 => f64::from(u16::MAX),
            Number::I32 => f64::from(i32::MAX),
            Number::U32 => f64::from(u32::MAX),
            Number::F32 | Number::F64 => 1.0,
        }
    }
}

impl Columns {
    /// The numbers of a vertex.
    #[inline]
    pub fn of(&self, vertex: usize) -> &[f64] {
        let n = self.columns.len();
        &self.values[vertex * n..(vertex + 1) * n]
    }

    /// Where the parts of something of so many parts are, if all are there.
    pub fn find<const N: usize>(&self, part: impl Fn(usize) -> Meaning) -> Option<[usize; N]> {
        find(&self.columns, part)
    }
}

/// Where the parts of something of so many parts are among `columns`, if all are there.
pub fn find<const N: usize>(columns: &[Column], part: impl Fn(usize) -> Meaning) -> Option<[usize; N]> {
    let at = std::array::from_fn(|i| columns.iter().position(|c| c.meaning == part(i)));
    at.iter().all(Option::is_some).then(|| at.map(|i| i.unwrap_or(0)))
}
