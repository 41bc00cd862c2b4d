//! Writes PLY and STL files of any layout, as a test says.

/// How numbers are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Encoding {
    Ascii,
    Little,
    Big,
}

pub const ENCODINGS: [Encoding; 3] = [Encoding::Ascii, Encoding::Little, Encoding::Big];

/// The type of a property: a scalar's, or that of a list's count and items.
#[derive(Debug, Clone, Copy)]
pub enum Type {
    One(&'static str),
    List(&'static str, &'static str),
}

/// The value of a property.
#[derive(Debug, Clone)]
pub enum Value {
    One(f64),
    List(Vec<f64>),
}

#[derive(Debug, Clone)]
pub struct Element {
    pub name: &'static str,
    pub properties: Vec<(&'static str, Type)>,
    pub records: Vec<Vec<Value>>,
}

/// The number as it is after it was stored in this type.
pub fn stored(kind: &str, x: f64) -> f64 {
    match kind {
        "float" | "float32" => f64::from(x as f32),
        _ => x,
    }
}

pub fn number(out: &mut Vec<u8>, encoding: Encoding, kind: &str, x: f64) {
    macro_rules! put {
        ($type:ty) => {
            match encoding {
                Encoding::Little => out.extend((x as $type).to_le_bytes()),
                Encoding::Big => out.extend((x as $type).to_be_bytes()),
                Encoding::Ascii => out.extend(format!("{}", x as $type).bytes()),
            }
        };
    }
    match kind {
        "char" | "int8" => put!(i8),
        "uchar" | "uint8" => put!(u8),
        "short" | "int16" => put!(i16),
        "ushort" | "uint16" => put!(u16),
        "int" | "int32" => put!(i32),
        "uint" | "uint32" => put!(u32),
        "float" | "float32" => put!(f32),
        "double" | "float64" => put!(f64),
        other => panic!("{other}"),
    }
}

/// A header for these elements, its lines ended by `ending`.
pub fn header(encoding: Encoding, elements: &[Element], ending: &str) -> Vec<u8> {
    let format = match encoding {
        Encoding::Ascii => "ascii",
        Encoding::Little => "binary_little_endian",
        Encoding::Big => "binary_big_endian",
    };
    let mut lines = vec!["ply".to_string(), format!("format {format} 1.0")];
    for element in elements {
        lines.push(format!("element {} {}", element.name, element.records.len()));
        for (name, kind) in &element.properties {
            lines.push(match kind {
                Type::One(kind) => format!("property {kind} {name}"),
                Type::List(count, item) => format!("property list {count} {item} {name}"),
            });
        }
    }
    lines.push("end_header".into());
    lines.iter().flat_map(|line| [line.as_bytes(), ending.as_bytes()]).collect::<Vec<_>>().concat()
}

/// The payload; `space` and `ending` are what is put behind values and records of a text.
pub fn payload(encoding: Encoding, elements: &[Element], space: &str, ending: &str) -> Vec<u8> {
    let mut out = Vec::new();
    let put = |out: &mut Vec<u8>, kind: &str, x: f64| {
        number(out, encoding, kind, x);
        if encoding == Encoding::Ascii {
            out.extend(space.bytes());
        }
    };
    for element in elements {
        for record in &element.records {
            for ((_, kind), value) in element.properties.iter().zip(record) {
                match (kind, value) {
                    (Type::One(kind), Value::One(x)) => put(&mut out, kind, *x),
                    (Type::List(count, item), Value::List(items)) => {
                        put(&mut out, count, items.len() as f64);
                        items.iter().for_each(|x| put(&mut out, item, *x));
                    }
                    other => panic!("{other:?}"),
                }
            }
            if encoding == Encoding::Ascii {
                out.extend(ending.bytes());
            }
        }
    }
    out
}

pub fn ply(encoding: Encoding, elements: &[Element]) -> Vec<u8> {
    [header(encoding, elements, "\n"), payload(encoding, elements, " ", "\n")].concat()
}

/// Vertices of floats x, y, z.
pub fn vertices(positions: &[[f64; 3]]) -> Element {
    Element {
        name: "vertex",
        properties: ["x", "y", "z"].map(|name| (name, Type::One("float"))).to_vec(),
        records: positions.iter().map(|p| p.map(Value::One).to_vec()).collect(),
    }
}

/// Faces of a list of corners, `uchar` and `int`.
pub fn faces(polygons: &[&[u32]]) -> Element {
    let list = |p: &&[u32]| vec![Value::List(p.iter().map(|v| f64::from(*v)).collect())];
    Element {
        name: "face",
        properties: vec![("vertex_indices", Type::List("uchar", "int"))],
        records: polygons.iter().map(list).collect(),
    }
}

/// The four corners of a unit square and one above its middle.
pub const ROOF: [[f64; 3]; 5] = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0], [0.5, 0.5, 0.75]];

/// The sides of a roof.
pub const SIDES: [&[u32]; 4] = [&[0, 1, 4], &[1, 2, 4], &[2, 3, 4], &[3, 0, 4]];

pub fn roof() -> [Element; 2] {
    [vertices(&ROOF), faces(&SIDES)]
}

pub fn fan(polygon: &[u32]) -> Vec<[u32; 3]> {
    (2..polygon.len()).map(|i| [polygon[0], polygon[i - 1], polygon[i]]).collect()
}

pub fn binary_stl(head: &[u8], triangles: &[[[f64; 3]; 3]]) -> Vec<u8> {
    let mut out = head.to_vec();
    out.resize(80, 0);
    out.extend((triangles.len() as u32).to_le_bytes());
    for triangle in triangles {
        out.extend([0xff; 12]);
        triangle.as_flattened().iter().for_each(|x| number(&mut out, Encoding::Little, "float", *x));
        out.extend([1, 2]);
    }
    out
}

pub fn ascii_stl(name: &str, triangles: &[[[f64; 3]; 3]]) -> String {
    let mut out = format!("solid {name}\n");
    for triangle in triangles {
        out += "facet normal 0 0 1\n outer loop\n";
        for [x, y, z] in triangle {
            out += &format!("  vertex {x} {y} {z:e}\n");
        }
        out += " endloop\nendfacet\n";
    }
    out + &format!("endsolid {name}\n")
}

pub fn roof_soup() -> Vec<[[f64; 3]; 3]> {
    SIDES.iter().map(|f| [0, 1, 2].map(|i| ROOF[f[i] as usize])).collect()
}
