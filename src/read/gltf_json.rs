//! The JSON of a glTF file, without what may be as large as the mesh: embedded buffers are unpacked into scratch while the
//! text streams past, and a number stays in their place.

use super::map::Input;
use crate::error::{Error, Result};
use crate::scratch::{Scratch, ScratchFile};
use serde::Deserialize;
use std::collections::BTreeMap;

/// The longest text that is held: that of a scene of tens of thousands of objects, embedded buffers not counted.
const TEXT_BYTES: usize = 8 << 20;

/// Bytes that are looked at, and unpacked, at a time.
const PIECE_BYTES: usize = 64 << 10;

/// What a string begins with that holds a buffer.
const DATA: &[u8] = b"data:";

/// What a placeholder begins with: no path that a file names begins so.
const UNPACKED: &str = "\u{1}unpacked:";

/// The longest media type in front of the bytes of an embedded buffer.
const MEDIA_BYTES: usize = 256;

/// As much of a document as is read.
#[derive(Debug, Default, Deserialize)]
#[serde(rename_all = "camelCase", default)]
pub(super) struct Document {
    pub scene: Option<usize>,
    pub scenes: Vec<Scene>,
    pub nodes: Vec<Node>,
    pub meshes: Vec<Mesh>,
    pub accessors: Vec<Accessor>,
    pub buffer_views: Vec<View>,
    pub buffers: Vec<Buffer>,
    pub materials: Vec<Material>,
    pub textures: Vec<Texture>,
    pub images: Vec<Image>,
    pub extensions_required: Vec<String>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub(super) struct Scene {
    pub nodes: Vec<usize>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub(super) struct Node {
    pub name: Option<String>,
    pub mesh: Option<usize>,
    pub children: Vec<usize>,
    pub matrix: Option<[f64; 16]>,
    pub translation: Option<[f64; 3]>,
    pub rotation: Option<[f64; 4]>,
    pub scale: Option<[f64; 3]>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub(super) struct Mesh {
    pub name: Option<String>,
    pub primitives: Vec<Primitive>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub(super) struct Primitive {
    pub attributes: BTreeMap<String, usize>,
    pub indices: Option<usize>,
    pub mode: Option<u32>,
    pub material: Option<usize>,
    pub extensions: BTreeMap<String, serde::de::IgnoredAny>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(rename_all = "camelCase", default)]
pub(super) struct Accessor {
    pub buffer_view: Option<usize>,
    pub byte_offset: u64,
    pub component_type: u32,
    pub normalized: bool,
    pub count: u64,
    #[serde(rename = "type")]
    pub shape: String,
    pub min: Vec<f64>,
    pub max: Vec<f64>,
    pub sparse: Option<serde::de::IgnoredAny>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(rename_all = "camelCase", default)]
pub(super) struct View {
    pub buffer: usize,
    pub byte_offset: u64,
    pub byte_length: u64,
    pub byte_stride: Option<u64>,
    pub extensions: BTreeMap<String, serde::de::IgnoredAny>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(rename_all = "camelCase", default)]
pub(super) struct Buffer {
    pub uri: Option<String>,
    pub byte_length: u64,
}

#[derive(Debug, Default, Deserialize)]
#[serde(rename_all = "camelCase", default)]
pub(super) struct Material {
    pub name: Option<String>,
    pub pbr_metallic_roughness: Surface,
    pub alpha_mode: Option<String>,
    pub extensions: MaterialExtensions,
}

/// The base of a material, by the names that glTF and its older extension use.
#[derive(Debug, Default, Deserialize)]
#[serde(rename_all = "camelCase", default)]
pub(super) struct Surface {
    #[serde(alias = "diffuseFactor")]
    pub base_color_factor: Option<[f64; 4]>,
    #[serde(alias = "diffuseTexture")]
    pub base_color_texture: Option<TextureUse>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub(super) struct MaterialExtensions {
    #[serde(rename = "KHR_materials_pbrSpecularGlossiness")]
    pub specular_glossiness: Option<Surface>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(rename_all = "camelCase", default)]
pub(super) struct TextureUse {
    pub index: usize,
    pub tex_coord: usize,
    pub extensions: TextureExtensions,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub(super) struct TextureExtensions {
    #[serde(rename = "KHR_texture_transform")]
    pub transform: Option<TextureTransform>,
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Deserialize)]
#[serde(rename_all = "camelCase", default)]
pub(super) struct TextureTransform {
    pub offset: [f64; 2],
    pub rotation: f64,
    pub scale: Option<[f64; 2]>,
    pub tex_coord: Option<usize>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub(super) struct Texture {
    pub source: Option<usize>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(rename_all = "camelCase", default)]
pub(super) struct Image {
    pub name: Option<String>,
    pub uri: Option<String>,
    pub buffer_view: Option<usize>,
}

/// Where a buffer is.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Place<'a> {
    /// In the binary part of the same file.
    Here,
    /// Unpacked: the number of the scratch file.
    Unpacked(usize),
    /// In a file beside this one.
    Beside(&'a str),
}

impl Buffer {
    pub fn place(&self) -> Place<'_> {
        self.uri.as_deref().map_or(Place::Here, place)
    }
}

/// Where something is that has a URI.
pub(super) fn place(uri: &str) -> Place<'_> {
    match uri.strip_prefix(UNPACKED).and_then(|n| n.parse().ok()) {
        Some(number) => Place::Unpacked(number),
        None => Place::Beside(uri),
    }
}

/// Reads the document in these bytes of the file, and the buffers that it embeds.
pub(super) fn read(
    input: &Input,
    from: u64,
    len: u64,
    scratch: Option<&Scratch>,
) -> Result<(Document, Vec<ScratchFile>)> {
    let mut reader = Reader { input, scratch, text: Vec::new(), at: State::Outside, unpacked: Vec::new() };
    let mut piece = vec![0; PIECE_BYTES];
    let mut done = 0;
    while done < len {
        let some = (len - done).min(PIECE_BYTES as u64) as usize;
        input.read_at(&mut piece[..some], from + done)?;
        for (i, byte) in piece[..some].iter().enumerate() {
            reader.take(*byte).map_err(|what| match what {
                Fault::Wrong(what) => {
                    Error::Input { file: input.path().into(), item: None, byte: Some(from + done + i as u64), what }
                }
                Fault::Failed(error) => error,
            })?;
        }
        done += some as u64;
    }
    let text = reader.text.strip_prefix(b"\xef\xbb\xbf").unwrap_or(&reader.text);
    let document = serde_json::from_slice(text).map_err(|e| {
        let what: String = e.to_string().escape_debug().take(200).collect();
        Error::input(input.path(), format!("its JSON is not that of glTF: {what}"))
    })?;
    Ok((document, reader.unpacked))
}

enum Fault {
    Wrong(String),
    Failed(Error),
}

impl From<Error> for Fault {
    fn from(error: Error) -> Self {
        Fault::Failed(error)
    }
}

/// Copies the text, and turns embedded buffers into files.
struct Reader<'a> {
    input: &'a Input,
    scratch: Option<&'a Scratch>,
    text: Vec<u8>,
    at: State,
    unpacked: Vec<ScratchFile>,
}

/// Where in the text the reader is.
enum State {
    Outside,
    /// Within a string that began at this byte of the copy; whether a backslash came just before.
    Inside(usize, bool),
    /// Within what a string embeds.
    Embedded(Unpacking),
}

impl Reader<'_> {
    fn take(&mut self, byte: u8) -> Result<(), Fault> {
        match &mut self.at {
            State::Outside => {
                self.keep(byte)?;
                if byte == b'"' {
                    self.at = State::Inside(self.text.len(), false);
                }
            }
            State::Inside(begin, escaped) => {
                let (begin, ends) = (*begin, byte == b'"' && !*escaped);
                *escaped = byte == b'\\' && !*escaped;
                self.keep(byte)?;
                if ends {
                    self.at = State::Outside;
                } else if byte == b',' {
                    self.embed(begin)?;
                }
            }
            State::Embedded(unpacking) => match byte {
                b'"' => {
                    let length = unpacking.finish()?;
                    let State::Embedded(done) = std::mem::replace(&mut self.at, State::Outside) else { return Ok(()) };
                    // No texture is empty; an empty buffer is refused where it is used.
                    if let Some(file) = done.file.filter(|_| length > 0 || !done.is_picture) {
                        debug_assert_eq!(file.length(), length);
                        self.text.extend(format!("\\u0001unpacked:{}", self.unpacked.len()).bytes());
                        self.unpacked.push(file);
                    }
                    self.text.push(b'"');
                }
                // `/` may be written as `\/`.
                b'\\' => {}
                _ => unpacking.take(byte)?,
            },
        }
        Ok(())
    }

    fn keep(&mut self, byte: u8) -> Result<(), Fault> {
        if self.text.len() == TEXT_BYTES {
            return Err(Fault::Wrong(format!("its JSON goes on here; at most {TEXT_BYTES} bytes of it are read")));
        }
        self.text.push(byte);
        Ok(())
    }

    /// At the first comma of a string: if it says that bytes follow, goes on to those.
    fn embed(&mut self, begin: usize) -> Result<(), Fault> {
        let media = &self.text[begin..];
        if !media.starts_with(DATA) || media.len() > MEDIA_BYTES || !media.ends_with(b";base64,") {
            return Ok(());
        }
        let is_picture = media.starts_with(b"data:image");
        let file = match self.scratch {
            Some(scratch) => Some(scratch.file()?),
            // Whoever has no scratch wants no textures.
            None if is_picture => None,
            None => {
                let what = "embeds its buffers, which needs a folder for scratch to unpack them into";
                return Err(Fault::Failed(Error::input(self.input.path(), what)));
            }
        };
        self.text.truncate(begin);
        let nothing = Unpacking { file, is_picture, bytes: Vec::new(), length: 0, bits: 0, held: 0, padded: false };
        self.at = State::Embedded(nothing);
        Ok(())
    }
}

/// Base64 on its way into a file.
struct Unpacking {
    file: Option<ScratchFile>,
    is_picture: bool,
    bytes: Vec<u8>,
    length: u64,
    bits: u32,
    held: u32,
    padded: bool,
}

impl Unpacking {
    fn take(&mut self, byte: u8) -> Result<(), Fault> {
        let value = match byte {
            b'A'..=b'Z' => byte - b'A',
            b'a'..=b'z' => byte - b'a' + 26,
            b'0'..=b'9' => byte - b'0' + 52,
            b'+' | b'-' => 62,
            b'/' | b'_' => 63,
            b'=' => {
                self.padded = true;
                return Ok(());
            }
            _ => return Err(Fault::Wrong("a byte that base64 does not have".into())),
        };
        if self.padded {
            return Err(Fault::Wrong("base64 that goes on behind its end".into()));
        }
        self.bits = self.bits << 6 | u32::from(value);
        self.held += 6;
        if self.held >= 8 {
            self.held -= 8;
            self.bytes.push((self.bits >> self.held) as u8);
            if self.bytes.len() == PIECE_BYTES {
                self.flush()?;
            }
        }
        Ok(())
    }

    fn flush(&mut self) -> Result<(), Fault> {
        if let Some(file) = &self.file {
            file.write_all_at(&self.bytes, self.length)?;
            self.length += self.bytes.len() as u64;
        }
        self.bytes.clear();
        Ok(())
    }

    fn finish(&mut self) -> Result<u64, Fault> {
        self.flush()?;
        Ok(self.length)
    }
}
