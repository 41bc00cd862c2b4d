//! Writes glTF files, as a test says.

use super::write::{ROOF, SIDES};
use serde_json::{Value, json};

/// Bytes of a buffer, each part at a multiple of four.
#[derive(Default, Clone)]
pub struct Bin(pub Vec<u8>);

impl Bin {
    /// Appends; offset and length.
    pub fn put(&mut self, bytes: &[u8]) -> (usize, usize) {
        self.0.resize(self.0.len().next_multiple_of(4), 0);
        let at = self.0.len();
        self.0.extend_from_slice(bytes);
        (at, bytes.len())
    }
}

/// A document, and its only buffer.
#[derive(Clone)]
pub struct Gltf {
    pub json: Value,
    pub bin: Vec<u8>,
}

/// A roof with 16-bit indices, as one mesh of one node.
pub fn roof() -> Gltf {
    let mut bin = Bin::default();
    let positions = bin.put(&floats(&ROOF));
    let corners: Vec<u8> = SIDES.iter().flat_map(|s| s.iter().flat_map(|v| (*v as u16).to_le_bytes())).collect();
    let indices = bin.put(&corners);
    let json = json!({
        "asset": { "version": "2.0" },
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
        "nodes": [{ "mesh": 0 }],
        "meshes": [{ "primitives": [{ "attributes": { "POSITION": 0 }, "indices": 1 }] }],
        "accessors": [
            { "bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 5, "min": [0, 0, 0], "max": [1, 1, 0.75] },
            { "bufferView": 1, "componentType": 5123, "type": "SCALAR", "count": 12 },
        ],
        "bufferViews": [view(positions), view(indices)],
        "buffers": [{ "byteLength": bin.0.len() }],
    });
    Gltf { json, bin: bin.0 }
}

pub fn view((offset, length): (usize, usize)) -> Value {
    json!({ "buffer": 0, "byteOffset": offset, "byteLength": length })
}

pub fn floats(positions: &[[f64; 3]]) -> Vec<u8> {
    positions.as_flattened().iter().flat_map(|x| (*x as f32).to_le_bytes()).collect()
}

impl Gltf {
    pub fn glb(&self) -> Vec<u8> {
        let mut text = self.json.to_string().into_bytes();
        text.resize(text.len().next_multiple_of(4), b' ');
        let mut bin = self.bin.clone();
        bin.resize(bin.len().next_multiple_of(4), 0);
        let words = |words: &[u32]| words.iter().flat_map(|w| w.to_le_bytes()).collect::<Vec<u8>>();
        let length = 28 + text.len() + bin.len();
        [
            b"glTF".to_vec(),
            words(&[2, length as u32, text.len() as u32, 0x4e4f_534a]),
            text,
            words(&[bin.len() as u32, 0x004e_4942]),
            bin,
        ]
        .concat()
    }

    /// With the buffer at `uri`.
    pub fn beside(&self, uri: &str) -> String {
        let mut json = self.json.clone();
        json["buffers"][0]["uri"] = uri.into();
        json.to_string()
    }

    /// With the buffer within.
    pub fn embedded(&self) -> String {
        self.beside(&format!("data:application/octet-stream;base64,{}", base64(&self.bin)))
    }
}

pub fn base64(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut text = String::new();
    for group in bytes.chunks(3) {
        let n = group.iter().enumerate().fold(0u32, |n, (i, b)| n | u32::from(*b) << (16 - 8 * i));
        (0..=group.len()).for_each(|i| text.push(DIGITS[(n >> (18 - 6 * i)) as usize & 63] as char));
        (group.len()..3).for_each(|_| text.push('='));
    }
    text
}
