//! Columns of texts from a set known in advance: an index per row, and each text once.

use std::collections::HashMap;
use std::sync::Arc;

use arrow_array::builder::PrimitiveBuilder;
use arrow_array::types::ArrowDictionaryKeyType;
use arrow_array::{ArrayRef, DictionaryArray, StringArray};
use arrow_schema::DataType;

/// A column under construction. All its batches have the same texts, so that readers who join batches need not compare them.
pub struct Texts<K: ArrowDictionaryKeyType> {
    texts: Arc<StringArray>,
    keys: PrimitiveBuilder<K>,
}

impl<K: ArrowDictionaryKeyType> Texts<K> {
    /// A column of these texts, all of them different; there must be fewer than the index type can count.
    pub fn new<T: AsRef<str>>(texts: impl IntoIterator<Item = T>) -> Self {
        Self { texts: Arc::new(StringArray::from_iter_values(texts)), keys: PrimitiveBuilder::new() }
    }

    /// An empty column with the same texts.
    pub fn another(&self) -> Self {
        Self { texts: Arc::clone(&self.texts), keys: PrimitiveBuilder::new() }
    }

    /// The type of such a column.
    pub fn data_type() -> DataType {
        DataType::Dictionary(Box::new(K::DATA_TYPE), Box::new(DataType::Utf8))
    }

    /// Appends the text with this index.
    pub fn push(&mut self, key: K::Native) {
        self.keys.append_value(key);
    }

    /// Appends the text with this index, or null.
    pub fn push_option(&mut self, key: Option<K::Native>) {
        self.keys.append_option(key);
    }

    /// Appends the text with this index several times.
    pub fn push_n(&mut self, key: K::Native, times: usize) {
        self.keys.append_value_n(key, times);
    }

    /// Appends null several times.
    pub fn push_none(&mut self, times: usize) {
        self.keys.append_nulls(times);
    }

    /// Makes room for so many rows in an empty column.
    pub fn expect(&mut self, rows: usize) {
        self.keys = PrimitiveBuilder::with_capacity(rows);
    }

    /// Appends the texts of these indexes.
    pub fn push_slice(&mut self, keys: &[K::Native]) {
        self.keys.append_slice(keys);
    }

    /// Appends the texts of these indexes; none where `is_text` is false.
    pub fn push_all(&mut self, keys: &[K::Native], is_text: &[bool]) {
        self.keys.append_values(keys, is_text);
    }

    /// Returns the column so far; the next one starts empty.
    pub fn take(&mut self) -> ArrayRef {
        let texts = Arc::clone(&self.texts) as ArrayRef;
        Arc::new(DictionaryArray::new(self.keys.finish(), texts))
    }
}

/// Texts without duplicates, in the order in which they came.
#[derive(Default)]
pub struct Interned {
    texts: Vec<String>,
    places: HashMap<String, i32>,
}

impl Interned {
    /// A text's place, which is a new one if it was not there.
    pub fn place(&mut self, text: &str) -> i32 {
        if let Some(place) = self.places.get(text) {
            return *place;
        }
        let place = self.texts.len() as i32;
        self.texts.push(text.to_owned());
        self.places.insert(text.to_owned(), place);
        place
    }

    /// All of them.
    pub fn into_texts(self) -> Vec<String> {
        self.texts
    }
}
