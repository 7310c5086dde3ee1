// SPDX-License-Identifier: Apache-2.0
#include "ros/bag/bag_check.h"

#include <fcntl.h>
#include <rosbag/chunked_file.h>
#include <rosbag/exceptions.h>
#include <rosbag/stream.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstdint>
#include <cstring>
#include <map>
#include <set>
#include <string>
#include <string_view>
#include <vector>

#include "omnister/common/error.h"

namespace omnister {
namespace {

constexpr std::string_view kMagic = "#ROSBAG V2.0\n";
constexpr std::uint32_t kMaxHeader = 1u << 20;
constexpr std::uint32_t kMaxChunk = 1u << 30;  ///< unpacked; it is held in memory
constexpr std::uint32_t kNanoseconds = 1000000000;

enum Op { kMessage = 2, kBagHeader = 3, kIndex = 4, kChunk = 5, kChunkInfo = 6, kConnection = 7 };

/// Bytes with a place each: a file, or a chunk in memory.
class Source {
 public:
  virtual ~Source() = default;
  virtual std::uint64_t size() const = 0;
  /// @param at, count within size()
  virtual void read(std::uint64_t at, void* to, std::size_t count) = 0;
};

class Memory : public Source {
 public:
  explicit Memory(std::vector<std::uint8_t> bytes) : bytes_(std::move(bytes)) {}
  std::uint64_t size() const override { return bytes_.size(); }
  void read(std::uint64_t at, void* to, std::size_t count) override {
    std::copy_n(bytes_.data() + at, count, static_cast<std::uint8_t*>(to));
  }

 private:
  std::vector<std::uint8_t> bytes_;
};

/// A file through a small window, as records' heads are often close to each other.
class File : public Source {
 public:
  explicit File(const std::filesystem::path& path)
      : name_(path.string()), fd_(::open(path.c_str(), O_RDONLY | O_CLOEXEC | O_NONBLOCK)) {
    if (fd_ < 0) throw IoError("open", name_, errno);
    struct stat info {};
    if (::fstat(fd_, &info) != 0 || !S_ISREG(info.st_mode)) {
      ::close(fd_);
      throw InputError(name_, "", "is not a file, expected a bag");
    }
    size_ = static_cast<std::uint64_t>(info.st_size);
  }
  ~File() override { ::close(fd_); }
  File(const File&) = delete;
  File& operator=(const File&) = delete;

  std::uint64_t size() const override { return size_; }
  void read(std::uint64_t at, void* to, std::size_t count) override {
    if (at < begin_ || at + count > begin_ + window_.size()) {
      window_.resize(
          static_cast<std::size_t>(std::min<std::uint64_t>(std::max(count, kWindow), size_ - at)));
      begin_ = at;
      fill();
    }
    std::copy_n(window_.data() + (at - begin_), count, static_cast<char*>(to));
  }

 private:
  static constexpr std::size_t kWindow = 1u << 15;

  void fill() {
    std::size_t done = 0;
    while (done < window_.size()) {
      const ssize_t n = ::pread(fd_, window_.data() + done, window_.size() - done,
                                static_cast<off_t>(begin_ + done));
      if (n < 0 && errno == EINTR) continue;
      if (n < 0) throw IoError("read", name_, errno);
      if (n == 0) throw InputError(name_, "", "became shorter while it was read");
      done += static_cast<std::size_t>(n);
    }
  }

  const std::string name_;
  const int fd_;
  std::uint64_t size_ = 0;
  std::uint64_t begin_ = 0;
  std::vector<char> window_;
};

struct Record {
  int op = 0;
  std::map<std::string, std::string> fields;
  std::uint64_t data = 0;  ///< where it begins
  std::uint32_t size = 0;  ///< of the data
  std::uint64_t end() const { return data + size; }
};

class BagCheck {
 public:
  explicit BagCheck(const std::filesystem::path& path) : name_(path.string()), file_(path) {}

  BagFacts check() {
    std::string magic(std::min<std::uint64_t>(kMagic.size(), file_.size()), '\0');
    file_.read(0, magic.data(), magic.size());
    if (magic != kMagic)
      throw InputError(
          name_, "",
          "is not a whole bag of format 2.0: it begins with \"" + printable(magic, 20) + "\"");
    const Record head = record(file_, kMagic.size());
    if (head.op != kBagHeader) refuse("the first record is not the bag's own");
    readHead(head);
    std::uint64_t at = head.end();
    while (at < index_at_) at = checkChunk(at);
    if (at != index_at_) refuse("the index is not where the bag says");
    for (std::uint32_t i = 0; i < connection_count_; ++i) at = checkConnection(at);
    for (const std::uint32_t id : used_)
      if (connections_.count(id) == 0) refuse("a message is of a topic that is not there");
    for (std::uint32_t i = 0; i < chunk_count_; ++i) at = checkChunkInfo(at);
    return facts_;
  }

 private:
  [[noreturn]] void refuse(const std::string& problem) const {
    throw InputError(name_, "",
                     "is not a whole bag: " + problem + " (byte " + std::to_string(file_at_) +
                         "; rosbag reindex mends one that was cut off)");
  }

  template <typename T>
  static T take(Source& source, std::uint64_t at) {
    T value{};
    source.read(at, &value, sizeof(T));
    return value;
  }

  Record record(Source& source, std::uint64_t at) {
    if (&source == &file_) file_at_ = at;
    const auto need = [&](std::uint64_t from, std::uint64_t count) {
      if (source.size() < from || source.size() - from < count) refuse("a record is cut off");
    };
    need(at, 4);
    const auto length = take<std::uint32_t>(source, at);
    if (length > kMaxHeader) refuse("a record's header is too long");
    need(at + 4, std::uint64_t{length} + 4);
    header_.resize(length);
    source.read(at + 4, header_.data(), length);
    Record out;
    parseFields(header_, out.fields);
    out.op = number<std::uint8_t>(out, "op");
    out.data = at + 4 + length + 4;
    out.size = take<std::uint32_t>(source, out.data - 4);
    need(out.data, out.size);
    return out;
  }

  void parseFields(std::string_view text, std::map<std::string, std::string>& fields) const {
    while (!text.empty()) {
      std::uint32_t length = 0;
      if (text.size() < sizeof length) refuse("a record's header is damaged");
      std::memcpy(&length, text.data(), sizeof length);
      text.remove_prefix(sizeof length);
      const std::string_view field = text.substr(0, length);
      const std::size_t equals = field.find('=');
      if (field.size() != length || equals == std::string_view::npos)
        refuse("a record's header is damaged");
      // The last of equal names counts, as for rosbag.
      fields[std::string(field.substr(0, equals))] = field.substr(equals + 1);
      text.remove_prefix(length);
    }
  }

  const std::string& field(const Record& record, const char* name) const {
    const auto found = record.fields.find(name);
    if (found == record.fields.end()) refuse(std::string("a record has no field ") + name);
    return found->second;
  }

  template <typename T>
  T number(const Record& record, const char* name) const {
    const std::string& bytes = field(record, name);
    T value{};
    if (bytes.size() != sizeof value) refuse(std::string("a field ") + name + " is damaged");
    std::memcpy(&value, bytes.data(), sizeof value);
    return value;
  }

  void readHead(const Record& head) {
    index_at_ = number<std::uint64_t>(head, "index_pos");
    connection_count_ = number<std::uint32_t>(head, "conn_count");
    chunk_count_ = number<std::uint32_t>(head, "chunk_count");
    // A plugin of the bag's choice would be loaded.
    const auto encryptor = head.fields.find("encryptor");
    if (encryptor != head.fields.end() && !encryptor->second.empty() &&
        encryptor->second != "rosbag/NoEncryptor")
      throw InputError(name_, "", "is encrypted, which cannot be read");
    if (index_at_ == 0) refuse("it has no index");
    if (index_at_ < head.end() || index_at_ > file_.size()) refuse("the index is not in it");
  }

  /// A chunk and the index records behind it. @return the end of these
  std::uint64_t checkChunk(std::uint64_t begin) {
    const Record chunk = record(file_, begin);
    if (chunk.op != kChunk) refuse("a record stands where none of its kind may");
    const std::vector<std::uint32_t> messages = messagesOf(chunk);
    std::uint32_t& indexes = chunks_[begin];
    std::uint64_t at = chunk.end();
    while (at < index_at_) {
      const Record index = record(file_, at);
      if (index.op != kIndex) break;
      checkIndex(index, messages);
      ++indexes;
      at = index.end();
    }
    return at;
  }

  void checkIndex(const Record& index, const std::vector<std::uint32_t>& messages) {
    if (number<std::uint32_t>(index, "ver") != 1) refuse("an index is of another version");
    used_.insert(number<std::uint32_t>(index, "conn"));
    constexpr std::uint64_t kEntry = 12;
    if (number<std::uint32_t>(index, "count") * kEntry != index.size)
      refuse("an index has another length than it says");
    for (std::uint64_t at = index.data; at < index.end(); at += kEntry) {
      const auto seconds = take<std::uint32_t>(file_, at);
      const auto nanoseconds = take<std::uint32_t>(file_, at + 4);
      if (nanoseconds >= kNanoseconds) refuse("an index holds what is no time");
      if (seconds == 0 && nanoseconds == 0) ++facts_.untimed;
      if (!std::binary_search(messages.begin(), messages.end(), take<std::uint32_t>(file_, at + 8)))
        refuse("an index points where no message is");
    }
  }

  /// Where in a chunk, unpacked, an index may point.
  std::vector<std::uint32_t> messagesOf(const Record& chunk) {
    const std::string& compression = field(chunk, "compression");
    const auto size = number<std::uint32_t>(chunk, "size");
    if (size > kMaxChunk) refuse("a chunk is larger than " + std::to_string(kMaxChunk) + " bytes");
    if (compression == "none") {
      if (size != chunk.size) refuse("a chunk has another length than it says");
      return messagesIn(file_, chunk.data, chunk.end());
    }
    rosbag::compression::CompressionType type;
    if (compression == "bz2")
      type = rosbag::compression::BZ2;
    else if (compression == "lz4")
      type = rosbag::compression::LZ4;
    else
      refuse("a chunk is packed in an unknown way");
    std::vector<std::uint8_t> packed(chunk.size), bytes(size);
    file_.read(chunk.data, packed.data(), packed.size());
    try {
      rosbag::ChunkedFile unused;
      rosbag::StreamFactory(&unused).getStream(type)->decompress(bytes.data(), size, packed.data(),
                                                                 chunk.size);
    } catch (const rosbag::BagException&) {
      refuse("a chunk cannot be unpacked");
    }
    Memory unpacked(std::move(bytes));
    return messagesIn(unpacked, 0, size);
  }

  std::vector<std::uint32_t> messagesIn(Source& source, std::uint64_t begin, std::uint64_t end) {
    std::vector<std::uint32_t> out;
    std::size_t messages = 0;  // of `out`; what comes behind leads to none yet
    for (std::uint64_t at = begin; at < end;) {
      const Record inner = record(source, at);
      if (inner.end() > end) refuse("a record goes beyond its chunk");
      // The index may point at a topic's record that comes before its first message.
      out.push_back(static_cast<std::uint32_t>(at - begin));
      if (inner.op == kMessage) {
        number<std::uint32_t>(inner, "conn");
        messages = out.size();
      } else if (inner.op != kConnection) {
        refuse("a chunk holds what is no message");
      }
      at = inner.end();
    }
    out.resize(messages);
    return out;
  }

  std::uint64_t checkConnection(std::uint64_t at) {
    const Record connection = record(file_, at);
    if (connection.op != kConnection) refuse("a topic is missing from the index");
    if (field(connection, "topic").empty()) refuse("a topic has no name");
    // What describes the topic has the form of a header, too.
    if (connection.size > kMaxHeader) refuse("what describes a topic is too long");
    header_.resize(connection.size);
    file_.read(connection.data, header_.data(), header_.size());
    std::map<std::string, std::string> described;
    parseFields(header_, described);
    connections_.insert(number<std::uint32_t>(connection, "conn"));
    return connection.end();
  }

  std::uint64_t checkChunkInfo(std::uint64_t at) {
    const Record info = record(file_, at);
    if (info.op != kChunkInfo) refuse("a chunk is missing from the index");
    const auto chunk = chunks_.find(number<std::uint64_t>(info, "chunk_pos"));
    if (chunk == chunks_.end()) refuse("the index points where no chunk is");
    const auto count = number<std::uint32_t>(info, "count");
    if (info.size != count * std::uint64_t{8} || count > chunk->second)
      refuse("a chunk has less of an index than the bag says");
    return info.end();
  }

  const std::string name_;
  File file_;
  std::uint64_t file_at_ = 0;  ///< record of the file that is looked at
  std::string header_;         ///< bytes of the one being read
  std::uint64_t index_at_ = 0;
  std::uint32_t connection_count_ = 0;
  std::uint32_t chunk_count_ = 0;
  std::map<std::uint64_t, std::uint32_t> chunks_;  ///< index records behind each chunk, by place
  std::set<std::uint32_t> used_;                   ///< topics of messages
  std::set<std::uint32_t> connections_;            ///< topics in the index
  BagFacts facts_;
};

}  // namespace

BagFacts checkBag(const std::filesystem::path& path) { return BagCheck(path).check(); }

}  // namespace omnister
