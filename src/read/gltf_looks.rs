//! Materials of glTF: of each its base colour, how opaque it is, and its base texture, wherever that is. What else glTF
//! knows of light is passed over. Objects that have names are groups.

use super::attribute::{Attribute, Carrier};
use super::gltf::Patch;
use super::gltf_coat::shown as as_shown;
use super::gltf_json::{Document, Image, TextureTransform, TextureUse};
use super::gltf_scene::{Builder, unescaped};
use crate::mesh::coat::{self, Look, Picture};
use glam::{DMat2, DVec2};
use rustc_hash::FxHashMap;

/// Materials in use, textures, and objects by name.
#[derive(Debug, Default)]
pub(super) struct Looks {
    pub names: Vec<String>,
    pub looks: Vec<Look>,
    pub pictures: Vec<Picture>,
    /// Textures that cannot be had.
    pub lost: Vec<String>,
    pub groups: Vec<String>,
}

impl Looks {
    /// Whether any of it is worth carrying: a plain material, or one object, says nothing.
    pub fn is_plain(&self) -> bool {
        self.names.is_empty() && self.groups.is_empty()
    }

    /// Takes off faces what is not worth carrying.
    pub fn tidy(&self, patches: &mut [Patch]) {
        for patch in patches {
            let has = |list: &[String]| !list.is_empty();
            patch.belongs.material = patch.belongs.material.filter(|_| has(&self.names));
            patch.belongs.group = patch.belongs.group.filter(|_| has(&self.groups));
        }
    }

    pub fn attributes(&self) -> Vec<Attribute> {
        let list = |name: &str, of: &[String]| {
            let kind = format!("{} by name", of.len());
            (!of.is_empty()).then(|| Attribute::of(Carrier::Face, name, kind))
        };
        [list("material", &self.names), list("node", &self.groups)].into_iter().flatten().collect()
    }
}

/// What faces refer to, numbered as it comes.
#[derive(Debug, Default)]
pub(super) struct Wanted {
    materials: Vec<usize>,
    numbers: FxHashMap<usize, u32>,
    groups: Vec<String>,
    named: FxHashMap<String, u32>,
}

impl Wanted {
    /// The number of a material; one that is not there has none.
    pub fn material(&mut self, document: &Document, material: usize) -> u32 {
        // One that is not there is the plain one.
        let material = material.min(document.materials.len());
        *self.numbers.entry(material).or_insert_with(|| {
            self.materials.push(material);
            self.materials.len() as u32 - 1
        })
    }

    /// The number of a group.
    pub fn group(&mut self, name: &str) -> u32 {
        let name = tidy(name);
        *self.named.entry(name.clone()).or_insert_with(|| {
            self.groups.push(name);
            self.groups.len() as u32 - 1
        })
    }

    /// Finds out what materials look like, and where textures are.
    pub fn looks(self, builder: &mut Builder<'_>) -> Looks {
        let mut looks = Looks::default();
        let mut pictures: FxHashMap<usize, Option<usize>> = FxHashMap::default();
        for material in &self.materials {
            let Some(found) = builder.document().materials.get(*material) else {
                looks.names.push(unique("material", &looks.names));
                looks.looks.push(Look::default());
                continue;
            };
            let older = found.extensions.specular_glossiness.as_ref();
            let surface = older.unwrap_or(&found.pbr_metallic_roughness);
            let [r, g, b, alpha] = surface.base_color_factor.unwrap_or([1.0; 4]).map(|x| x.clamp(0.0, 1.0));
            let blends = found.alpha_mode.as_deref() == Some("BLEND");
            let picture = surface
                .base_color_texture
                .as_ref()
                .and_then(|texture| *pictures.entry(texture.index).or_insert_with(|| looks.picture(builder, texture)));
            let name = found.name.as_deref().map(tidy).filter(|name| !name.is_empty());
            looks.names.push(unique(name.as_deref().unwrap_or("material"), &looks.names));
            let alpha = if blends { alpha } else { 1.0 };
            looks.looks.push(Look { colour: [r, g, b].map(as_shown), alpha, picture });
        }
        if looks.looks.len() == 1 && looks.looks[0] == Look::default() && looks.lost.is_empty() {
            (looks.names, looks.looks) = (Vec::new(), Vec::new());
        }
        if self.groups.len() > 1 {
            looks.groups = self.groups;
        }
        looks
    }
}

impl Looks {
    /// Takes a texture.
    fn picture(&mut self, builder: &mut Builder<'_>, texture: &TextureUse) -> Option<usize> {
        let document = builder.document();
        let source = document.textures.get(texture.index).and_then(|texture| texture.source);
        let Some(image) = source.and_then(|image| document.images.get(image)) else {
            self.lost.push(format!("texture {}", texture.index));
            return None;
        };
        let name = file_name(image);
        let Some(place) = builder.picture(image) else {
            self.lost.push(name.unwrap_or_else(|| format!("texture {}", texture.index)));
            return None;
        };
        if let Some(known) = self.pictures.iter().position(|picture| picture.place == place) {
            return Some(known);
        }
        let name = name.unwrap_or_else(|| "texture".into());
        let taken: Vec<String> = self.pictures.iter().map(|picture| picture.name.clone()).collect();
        self.pictures.push(Picture { name: unique(&name, &taken), place });
        Some(self.pictures.len() - 1)
    }
}

/// The name of a texture's file, if it has one.
fn file_name(image: &Image) -> Option<String> {
    let of_file = image.uri.as_deref().filter(|uri| !uri.starts_with('\u{1}')).and_then(unescaped);
    let name = of_file.or_else(|| image.name.clone())?;
    let last = name.rsplit(['/', '\\']).next().map(tidy)?;
    (!last.is_empty() && last != "." && last != "..").then_some(last)
}

/// A name on one line.
fn tidy(name: &str) -> String {
    name.chars().filter(|c| !c.is_control()).take(200).collect::<String>().trim().to_string()
}

/// A name that none of these has; a number goes before its extension.
fn unique(name: &str, taken: &[String]) -> String {
    let (stem, extension) = name.rfind('.').filter(|at| *at > 0).map_or((name, ""), |at| name.split_at(at));
    let numbered = (2..).map(|i| format!("{stem}_{i}{extension}"));
    let free = |name: &String| !taken.contains(name);
    std::iter::once(name.to_string()).chain(numbered).find(free).unwrap_or_default()
}

/// How a material takes its texture from what vertices carry.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Texturing {
    set: usize,
    /// How coordinates are turned and moved first.
    pub turned: Option<TextureTransform>,
}

impl Texturing {
    pub fn of(document: &Document, material: Option<usize>) -> Texturing {
        let Some(material) = material.and_then(|material| document.materials.get(material)) else {
            return Texturing::default();
        };
        let older = material.extensions.specular_glossiness.as_ref();
        let surface = older.unwrap_or(&material.pbr_metallic_roughness);
        let Some(texture) = &surface.base_color_texture else { return Texturing::default() };
        let turned = texture.extensions.transform;
        Texturing { set: turned.and_then(|t| t.tex_coord).unwrap_or(texture.tex_coord), turned }
    }

    /// What vertices call the coordinates.
    pub fn name(&self) -> String {
        format!("TEXCOORD_{}", self.set)
    }
}

impl TextureTransform {
    /// Coordinates as the texture takes them.
    pub fn apply(&self, [s, t]: [f64; 2]) -> [f64; 2] {
        let scaled = DVec2::from_array(self.scale.unwrap_or([1.0; 2])) * DVec2::new(s, t);
        // Angles are counted from s away from t, which points down.
        (DMat2::from_angle(-self.rotation) * scaled + DVec2::from_array(self.offset)).to_array()
    }
}

/// The lists of a coat, and the patches of faces by number.
pub(super) fn patches(of: &[Patch]) -> (Vec<coat::Patch>, Vec<u32>) {
    let mut numbers: FxHashMap<&coat::Patch, u32> = FxHashMap::default();
    let mut list = Vec::new();
    let each = of.iter().map(|patch| {
        *numbers.entry(&patch.belongs).or_insert_with(|| {
            list.push(patch.belongs.clone());
            list.len() as u32 - 1
        })
    });
    let each = each.collect();
    (list, each)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_one_line_each_and_no_two_the_same() {
        let taken = ["bark.png", "bark_2.png", "stone"].map(String::from);
        assert_eq!(["bark.png", "stone", "moss"].map(|n| unique(n, &taken)), ["bark_3.png", "stone_2", "moss"]);
        assert_eq!(tidy(" a\nb\tc "), "abc");
        let image = |uri: Option<&str>, name: Option<&str>| Image {
            uri: uri.map(String::from),
            name: name.map(String::from),
            buffer_view: None,
        };
        assert_eq!(file_name(&image(Some("maps/a%20b.png"), Some("x"))).as_deref(), Some("a b.png"));
        assert_eq!(file_name(&image(Some("\u{1}unpacked:0"), Some("C:\\x\\bark"))).as_deref(), Some("bark"));
        assert_eq!(file_name(&image(None, Some("../.."))), None);
    }

    #[test]
    fn coordinates_are_scaled_turned_and_moved() {
        // The example of the extension: a quarter of the picture, turned by 90 degrees.
        let transform = TextureTransform {
            offset: [0.0, 1.0],
            rotation: std::f64::consts::FRAC_PI_2,
            scale: Some([0.5, 0.5]),
            tex_coord: None,
        };
        let [s, t] = transform.apply([1.0, 0.5]);
        assert!((s - 0.25).abs() < 1e-12 && (t - 0.5).abs() < 1e-12, "{s} {t}");
    }
}
