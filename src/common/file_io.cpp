// SPDX-License-Identifier: Apache-2.0
#include "omnister/common/file_io.h"

#include <fcntl.h>
#include <sys/stat.h>
#include <unistd.h>

#include <atomic>
#include <cerrno>
#include <cstdio>
#include <utility>

#include "omnister/common/error.h"

namespace omnister {
namespace {

namespace fs = std::filesystem;

class FileDescriptor {
 public:
  explicit FileDescriptor(int fd) : fd_(fd) {}
  ~FileDescriptor() {
    if (fd_ >= 0) ::close(fd_);
  }
  FileDescriptor(const FileDescriptor&) = delete;
  FileDescriptor& operator=(const FileDescriptor&) = delete;
  int get() const { return fd_; }
  int close() { return ::close(std::exchange(fd_, -1)); }

 private:
  int fd_;
};

fs::path folderOf(const fs::path& path) {
  const fs::path folder = path.parent_path();
  return folder.empty() ? fs::path(".") : folder;
}

// A new file is as readable as any other that the process makes; a replaced one keeps its mode.
mode_t modeFor(const fs::path& target) {
  struct stat info {};
  if (::stat(target.c_str(), &info) == 0) return info.st_mode & 07777;
  return 0644;
}

fs::path temporaryFor(const fs::path& target) {
  static std::atomic<unsigned> counter{0};
  // The extension stays last, since codecs choose the format by it.
  return folderOf(target) / ("." + target.stem().string() + "." + std::to_string(::getpid()) + "-" +
                             std::to_string(counter++) + ".tmp" + target.extension().string());
}

void syncPath(const fs::path& path, int flags) {
  FileDescriptor fd(::open(path.c_str(), flags | O_CLOEXEC));
  if (fd.get() < 0) throw IoError("open", path.string(), errno);
  if (::fsync(fd.get()) != 0 && errno != EINVAL && errno != EROFS) {
    throw IoError("sync", path.string(), errno);
  }
}

void writeAll(int fd, std::string_view bytes, const fs::path& path) {
  while (!bytes.empty()) {
    const ssize_t n = ::write(fd, bytes.data(), bytes.size());
    if (n < 0) {
      if (errno == EINTR) continue;
      throw IoError("write", path.string(), errno);
    }
    bytes.remove_prefix(static_cast<std::size_t>(n));
  }
}

fs::path resolveLink(fs::path path) {
  std::error_code ignored;
  if (fs::is_symlink(path, ignored)) {
    const fs::path resolved = fs::weakly_canonical(path, ignored);
    if (!ignored) return resolved;
  }
  return path;
}

}  // namespace

std::string readFile(const fs::path& path, std::size_t max_bytes) {
  FileDescriptor fd(::open(path.c_str(), O_RDONLY | O_CLOEXEC | O_NONBLOCK));
  if (fd.get() < 0) throw IoError("open", path.string(), errno);
  struct stat info {};
  if (::fstat(fd.get(), &info) != 0) throw IoError("read", path.string(), errno);
  if (!S_ISREG(info.st_mode)) throw InputError(path.string(), "", "is not a regular file");
  std::string bytes;
  char buffer[1 << 16];
  for (;;) {
    const ssize_t n = ::read(fd.get(), buffer, sizeof buffer);
    if (n < 0) {
      if (errno == EINTR) continue;
      throw IoError("read", path.string(), errno);
    }
    if (n == 0) return bytes;
    bytes.append(buffer, static_cast<std::size_t>(n));
    if (bytes.size() > max_bytes) {
      throw InputError(path.string(), "",
                       "is larger than the limit of " + std::to_string(max_bytes) + " bytes");
    }
  }
}

AtomicFile::AtomicFile(fs::path path)
    : target_(resolveLink(std::move(path))), temporary_(temporaryFor(target_)) {}

AtomicFile::~AtomicFile() {
  if (!committed_) ::unlink(temporary_.c_str());
}

void AtomicFile::commit(Previous previous) {
  std::error_code error;
  if (fs::is_directory(target_, error)) throw IoError("write", target_.string(), EISDIR);
  ::chmod(temporary_.c_str(), modeFor(target_));
  syncPath(temporary_, O_RDONLY);
  if (previous == Previous::kKeep) {
    // A hard link made beside and renamed: at no moment is either version missing.
    const fs::path backup = target_.string() + "~";
    const fs::path link = temporaryFor(backup);
    if (::link(target_.c_str(), link.c_str()) == 0) {
      if (::rename(link.c_str(), backup.c_str()) != 0) {
        const int reason = errno;
        ::unlink(link.c_str());
        throw IoError("write", backup.string(), reason);
      }
      // rename() of two names of one file leaves both in place.
      ::unlink(link.c_str());
    } else if (errno != ENOENT) {
      throw IoError("write", backup.string(), errno);
    }
  }
  if (::rename(temporary_.c_str(), target_.c_str()) != 0) {
    throw IoError("write", target_.string(), errno);
  }
  committed_ = true;
  syncPath(folderOf(target_), O_RDONLY | O_DIRECTORY);
}

void writeFileAtomically(const fs::path& path, std::string_view bytes, Previous previous) {
  AtomicFile file(path);
  {
    FileDescriptor fd(::open(file.path().c_str(), O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC, 0644));
    // Name the file that was asked for, not the temporary one.
    if (fd.get() < 0) throw IoError("write", path.string(), errno);
    writeAll(fd.get(), bytes, path);
    if (fd.close() != 0) throw IoError("write", path.string(), errno);
  }
  file.commit(previous);
}

}  // namespace omnister
