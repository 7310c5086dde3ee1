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
  // As long as any name that the folder takes, whatever the target's is.
  return folderOf(target) / ("." + target.filename().string().substr(0, 200) + "." +
                             std::to_string(::getpid()) + "-" + std::to_string(counter++) + ".tmp");
}

void syncFolder(const fs::path& path) {
  FileDescriptor fd(::open(path.c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC));
  if (fd.get() < 0) throw IoError("open", path.string(), errno);
  if (::fsync(fd.get()) != 0 && errno != EINVAL && errno != EROFS) {
    throw IoError("sync", path.string(), errno);
  }
}

// A second name for the file that stands at `target`, or a copy where one file has one name (FAT).
void keepPrevious(const fs::path& target) {
  const fs::path backup = target.string() + "~";
  // A hard link made beside and renamed: at no moment is either version missing.
  const fs::path link = temporaryFor(backup);
  if (::link(target.c_str(), link.c_str()) == 0) {
    if (::rename(link.c_str(), backup.c_str()) != 0) {
      const int reason = errno;
      ::unlink(link.c_str());
      throw IoError("write", backup.string(), reason);
    }
    // rename() of two names of one file leaves both in place.
    ::unlink(link.c_str());
  } else if (errno == EPERM || errno == EOPNOTSUPP || errno == EMLINK) {
    writeFileAtomically(backup, readFile(target));
  } else if (errno != ENOENT) {
    throw IoError("write", backup.string(), errno);
  }
}

fs::path resolveLink(fs::path path) {
  std::error_code ignored;
  if (fs::is_symlink(path, ignored)) {
    fs::path resolved = fs::weakly_canonical(path, ignored);
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
  const auto limit = [&](std::size_t size) {
    if (size <= max_bytes) return;
    throw InputError(path.string(), "",
                     "is larger than the limit of " + std::to_string(max_bytes) + " bytes");
  };
  // Before any of it is read; some files, as in /proc, say that they are empty.
  limit(static_cast<std::size_t>(info.st_size));
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
    limit(bytes.size());
  }
}

AtomicFile::AtomicFile(fs::path path) : target_(resolveLink(path)) {
  struct stat info {};
  if (::stat(path.c_str(), &info) == 0 && !S_ISREG(info.st_mode)) {
    openDirectly(path, info.st_mode);
    return;
  }
  // A file without a name gets one through /proc.
  if (::access("/proc/self/fd", X_OK) == 0) {
    fd_ = ::open(folderOf(target_).c_str(), O_TMPFILE | O_WRONLY | O_CLOEXEC, 0644);
    if (fd_ >= 0) return;
  }
  const fs::path name = temporaryFor(target_);
  fd_ = ::open(name.c_str(), O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC, 0644);
  // Name the file that was asked for, not the temporary one.
  if (fd_ < 0) throw IoError("write", target_.string(), errno);
  temporary_ = name;
}

void AtomicFile::openDirectly(const fs::path& path, mode_t mode) {
  if (S_ISDIR(mode)) throw IoError("write", path.string(), EISDIR);
  if (!S_ISCHR(mode) && !S_ISFIFO(mode)) {
    throw InputError(path.string(), "", "is no regular file and cannot be written");
  }
  // A pipe that nobody reads would wait for ever.
  fd_ = ::open(path.c_str(), O_WRONLY | O_CLOEXEC | O_NOCTTY | O_NONBLOCK);
  if (fd_ < 0) throw IoError("write", path.string(), errno);
  ::fcntl(fd_, F_SETFL, ::fcntl(fd_, F_GETFL) & ~O_NONBLOCK);
  direct_ = true;
}

AtomicFile::~AtomicFile() {
  if (fd_ >= 0) ::close(fd_);
  if (!temporary_.empty()) ::unlink(temporary_.c_str());
}

void AtomicFile::write(std::string_view bytes) {
  while (!bytes.empty()) {
    const ssize_t n = ::write(fd_, bytes.data(), bytes.size());
    if (n < 0) {
      if (errno == EINTR) continue;
      throw IoError("write", target_.string(), errno);
    }
    bytes.remove_prefix(static_cast<std::size_t>(n));
  }
}

void AtomicFile::finish() {
  std::error_code error;
  if (fs::is_directory(target_, error)) throw IoError("write", target_.string(), EISDIR);
  ::fchmod(fd_, modeFor(target_));
  if (::fsync(fd_) != 0 && errno != EINVAL && errno != EROFS) {
    throw IoError("sync", target_.string(), errno);
  }
}

int AtomicFile::giveName(const fs::path& name) {
  if (temporary_.empty()) {
    const std::string self = "/proc/self/fd/" + std::to_string(fd_);
    return ::linkat(AT_FDCWD, self.c_str(), AT_FDCWD, name.c_str(), AT_SYMLINK_FOLLOW) == 0 ? 0
                                                                                            : errno;
  }
  if (::renameat2(AT_FDCWD, temporary_.c_str(), AT_FDCWD, name.c_str(), RENAME_NOREPLACE) == 0) {
    temporary_.clear();
    return 0;
  }
  if (errno != EINVAL && errno != ENOSYS) return errno;
  return ::link(temporary_.c_str(), name.c_str()) == 0 ? 0 : errno;
}

void AtomicFile::commit(Previous previous) {
  if (direct_) return;
  finish();
  if (previous == Previous::kKeep) keepPrevious(target_);
  const int reason = giveName(target_);
  if (reason == EEXIST) {
    if (temporary_.empty()) {
      const fs::path name = temporaryFor(target_);
      if (const int failed = giveName(name); failed != 0)
        throw IoError("write", target_.string(), failed);
      temporary_ = name;
    }
    if (::rename(temporary_.c_str(), target_.c_str()) != 0) {
      throw IoError("write", target_.string(), errno);
    }
    temporary_.clear();
  } else if (reason != 0) {
    throw IoError("write", target_.string(), reason);
  }
  syncFolder(folderOf(target_));
}

bool AtomicFile::commitNew() {
  if (direct_) return false;
  finish();
  const int reason = giveName(target_);
  if (reason == EEXIST) return false;
  if (reason != 0) throw IoError("write", target_.string(), reason);
  syncFolder(folderOf(target_));
  return true;
}

void writeFileAtomically(const fs::path& path, std::string_view bytes, Previous previous) {
  AtomicFile file(path);
  file.write(bytes);
  file.commit(previous);
}

}  // namespace omnister
